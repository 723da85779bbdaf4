"""Compares a conversion with its source: every layer of an image is computed in two ways.

One way is `weights_conversion.forward`, in float64, on the source file in its own convention. The
other way is jaxsfm's network, in float32, on the converted file.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.core.blocks import Layer, convolve, pool
from jaxsfm.core.vgg import preprocess
from jaxsfm.errors import UserError
from jaxsfm.io.weight_files import ConvertedWeights, read_converted, read_extras
from weights_conversion.forward import layer_maps
from weights_conversion.source import Source

LIMIT = 1e-5
"""The largest difference of a map that is accepted, relative to the map's largest value. Rounding
to float32 leaves about 1e-6."""
SIZE = (64, 80)
"""Rows and columns of the image. It is not square, so that exchanged axes show."""


class MapComparison(NamedTuple):
    """How one map of the converted network differs from that of the source."""

    name: str
    shape: tuple[int, ...]
    largest: float
    """The largest absolute value of the source's map."""
    difference: float
    """The largest absolute difference over `largest`; infinite if the shapes differ."""


def noise_image(size: tuple[int, int]) -> np.ndarray:
    """Make noise whose strength differs between channels and corners, uint8 (h, w, 3)."""
    rng = np.random.default_rng(0)
    colours = rng.uniform(0, 1, (*size, 3)) * (255.0, 160.0, 90.0)
    slope = np.linspace(0, 1, size[0])[:, None, None] * np.linspace(0, 1, size[1])[:, None]
    return (colours * (0.3 + 0.7 * slope)).astype(np.uint8)


def converted_maps(found: ConvertedWeights, rgb: np.ndarray) -> dict[str, np.ndarray]:
    """Compute the maps of `layer_maps` with jaxsfm's network."""
    size = jnp.asarray([rgb.shape[:2]], jnp.int32)
    x = preprocess(jnp.asarray(rgb), found.preprocessing)[None]
    maps = {}
    for block in range(1, 6):
        names = [name for name in found.layers if name.startswith(f"conv{block}_")]
        for k, name in enumerate(names):
            kernel, bias = (jnp.asarray(found.layers[name][part]) for part in ("kernel", "bias"))
            x = convolve(nn.relu(x) if k else x, size, [Layer(kernel, bias)])
            maps[name] = x
        x = pool(x, size)
        size = size // 2
        maps[f"pool{block}"] = x
    return {name: np.asarray(value[0]) for name, value in jax.device_get(maps).items()}


def _compared(name: str, theirs: np.ndarray, ours: np.ndarray | None) -> MapComparison:
    largest = float(np.abs(theirs).max())
    if ours is None or ours.shape != theirs.shape:
        return MapComparison(name, theirs.shape, largest, float("inf"))
    # For a map of zeros the difference is absolute.
    difference = float(np.abs(theirs - ours).max()) / (largest or 1.0)
    return MapComparison(name, theirs.shape, largest, difference)


def compare(
    source: Source,
    converted: Path,
    *,
    size: tuple[int, int] = SIZE,
    shapes: Mapping[str, tuple[int, int]] | None = None,
) -> list[MapComparison]:
    """Compare every map of an image, and every extra array, of the source and the converted file.

    Args:
      source: the weights of the source file.
      converted: the converted file.
      size: rows and columns of the image.
      shapes: input and output channels of each layer; None takes those of the architecture.

    Raises:
      UserError: the converted file cannot be read, or holds another network.
    """
    rgb, found = noise_image(size), read_converted(converted, shapes=shapes)
    if found.architecture != source.architecture:
        raise UserError(
            f"{converted}: holds a {found.architecture}, but {source.path} a {source.architecture}"
        )
    ours = converted_maps(found, rgb)
    rows = [_compared(name, theirs, ours[name]) for name, theirs in layer_maps(source, rgb)]
    extras = read_extras(converted)
    return rows + [
        _compared(name, theirs, extras.get(name)) for name, theirs in source.extras.items()
    ]


def agrees(rows: list[MapComparison]) -> bool:
    """Whether every difference is within `LIMIT`."""
    return all(row.difference <= LIMIT for row in rows)


def table_lines(rows: list[MapComparison]) -> list[str]:
    """Return the comparison as a table with one line for each map."""
    head = f"{'map':24s} {'shape':>16s} {'largest value':>14s} {'difference / largest':>21s}"
    lines = [
        f"{row.name:24s} {' x '.join(map(str, row.shape)):>16s} {row.largest:14.6g} "
        f"{row.difference:21.2e}" + "  TOO LARGE" * (row.difference > LIMIT)
        for row in rows
    ]
    worst = max(row.difference for row in rows)
    verdict = "agree" if agrees(rows) else "DIFFER"
    return [head, *lines, f"{verdict}: largest difference {worst:.2e}, limit {LIMIT:g}"]
