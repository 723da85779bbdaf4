"""A conversion against its source: every layer of an image, by two independent ways.

The one way is `weights_conversion.forward` on the source file in its own convention, float64; the
other jaxsfm's network on the converted file, float32.
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
"""Of a map's largest difference over its largest value; float32 ends near 1e-6."""
SIZE = (64, 80)
"""Rows and columns of the image: not square, so that exchanged axes show."""


class Compared(NamedTuple):
    """One map."""

    name: str
    shape: tuple[int, ...]
    largest: float
    """Of the source's map, absolute."""
    difference: float
    """Largest absolute difference over `largest`; infinite where the shapes differ."""


def noise_image(size: tuple[int, int]) -> np.ndarray:
    """Noise of every frequency, of other strength in every channel and corner, uint8 (h, w, 3)."""
    rng = np.random.default_rng(0)
    colours = rng.uniform(0, 1, (*size, 3)) * (255.0, 160.0, 90.0)
    slope = np.linspace(0, 1, size[0])[:, None, None] * np.linspace(0, 1, size[1])[:, None]
    return (colours * (0.3 + 0.7 * slope)).astype(np.uint8)


def converted_maps(found: ConvertedWeights, rgb: np.ndarray) -> dict[str, np.ndarray]:
    """The same maps as `layer_maps`, by jaxsfm's network."""
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


def _compared(name: str, theirs: np.ndarray, ours: np.ndarray | None) -> Compared:
    largest = float(np.abs(theirs).max())
    if ours is None or ours.shape != theirs.shape:
        return Compared(name, theirs.shape, largest, float("inf"))
    # A map of zeros is compared by its absolute difference.
    difference = float(np.abs(theirs - ours).max()) / (largest or 1.0)
    return Compared(name, theirs.shape, largest, difference)


def compare(
    source: Source,
    converted: Path,
    *,
    size: tuple[int, int] = SIZE,
    shapes: Mapping[str, tuple[int, int]] | None = None,
) -> list[Compared]:
    """Every map of an image, and every extra array, of the source and of the converted file.

    Raises:
      UserError: the converted file cannot be read, or is of another network.
    """
    rgb, found = noise_image(size), read_converted(converted, shapes=shapes)
    if found.architecture != source.architecture:
        raise UserError(
            f"{converted}: of {found.architecture}, but {source.path} of {source.architecture}"
        )
    ours = converted_maps(found, rgb)
    rows = [_compared(name, theirs, ours[name]) for name, theirs in layer_maps(source, rgb)]
    extras = read_extras(converted)
    return rows + [
        _compared(name, theirs, extras.get(name)) for name, theirs in source.extras.items()
    ]


def agrees(rows: list[Compared]) -> bool:
    """Whether every difference is within `LIMIT`."""
    return all(row.difference <= LIMIT for row in rows)


def table_lines(rows: list[Compared]) -> list[str]:
    """One line a map."""
    head = f"{'map':24s} {'shape':>16s} {'largest value':>14s} {'difference / largest':>21s}"
    lines = [
        f"{row.name:24s} {' x '.join(map(str, row.shape)):>16s} {row.largest:14.6g} "
        f"{row.difference:21.2e}" + "  TOO LARGE" * (row.difference > LIMIT)
        for row in rows
    ]
    worst = max(row.difference for row in rows)
    verdict = "agree" if agrees(rows) else "DIFFER"
    return [head, *lines, f"{verdict}: largest difference {worst:.2e}, limit {LIMIT:g}"]
