"""Compares a conversion with its source: every layer of an image is computed in two ways.

One way is VGG-16 in numpy and float64, on the source file in the convention of its own framework:
channels first or last, BGR or RGB, convolution or correlation. This network is independent of
jaxsfm's network and of the conversion. Each tap of a kernel is added separately, which is slow;
images should be small. The other way is jaxsfm's network, in float32, on the converted file.
"""

from collections.abc import Iterator, Mapping
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
from jaxsfm.weights_conversion.source import Source

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


def _input(source: Source, rgb: np.ndarray) -> np.ndarray:
    """Preprocess an image as the framework does, with the axes in its order."""
    image = rgb.astype(np.float64)
    if source.convention.bgr:
        image = np.stack([image[..., 2], image[..., 1], image[..., 0]], axis=-1)
    scale, mean, std = source.preprocessing
    for channel in range(3):
        image[..., channel] = (image[..., channel] / scale - mean[channel]) / std[channel]
    return image if source.convention.layout == "HWIO" else np.moveaxis(image, -1, 0)


def _taps(size: int, tap: int, convolution: bool) -> tuple[slice, slice]:
    """Return, along one axis, the outputs to which a tap (0, 1 or 2) adds and the inputs it takes.

    A correlation is y[n] = sum over t of w[t] x[n + t - 1]; a convolution has x[n + 1 - t] instead.
    """
    shift = 1 - tap if convolution else tap - 1
    inside = slice(max(0, -shift), size - max(0, shift))
    return inside, slice(inside.start + shift, inside.stop + shift)


def _layer(x: np.ndarray, kernel: np.ndarray, bias: np.ndarray, source: Source) -> np.ndarray:
    """Apply one layer: a convolution with zero padding of one pixel, plus the bias."""
    convolution = source.convention.convolution
    kernel, bias = kernel.astype(np.float64), bias.astype(np.float64)
    last = source.convention.layout == "HWIO"
    height, width = x.shape[:2] if last else x.shape[1:]
    y = np.zeros((height, width, bias.size) if last else (bias.size, height, width))
    for i in range(3):
        rows, from_rows = _taps(height, i, convolution)
        for j in range(3):
            columns, from_columns = _taps(width, j, convolution)
            if last:
                y[rows, columns] += x[from_rows, from_columns] @ kernel[i, j]
            else:
                part = x[:, from_rows, from_columns]
                y[:, rows, columns] += np.tensordot(kernel[:, :, i, j], part, axes=(1, 0))
    return y + (bias if last else bias[:, None, None])


def _pool(x: np.ndarray, last: bool) -> np.ndarray:
    """Take the maximum of 2 x 2 values; an odd last row or column is dropped."""
    height, width = x.shape[:2] if last else x.shape[1:]
    height, width = height // 2 * 2, width // 2 * 2
    x = x[:height, :width] if last else x[:, :height, :width]
    corners = [x[i::2, j::2] if last else x[:, i::2, j::2] for i in (0, 1) for j in (0, 1)]
    return np.maximum.reduce(corners)


def layer_maps(source: Source, rgb: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Compute all maps of an image: conv1_1 .. conv5_3 before their rectifiers, and pool1 .. pool5.

    Args:
      source: the weights.
      rgb: (h, w, 3), 0 .. 255.

    Yields: the name of each map and the map, float64 (h, w, channels).
    """
    last = source.convention.layout == "HWIO"
    x = _input(source, rgb)
    names = [*source.layers, "end"]
    for (name, (kernel, bias)), following in zip(source.layers.items(), names[1:], strict=True):
        x = _layer(x, kernel, bias, source)
        yield name, x if last else np.moveaxis(x, 0, -1)
        x = np.maximum(x, 0.0)
        if following[:5] != name[:5]:  # this layer is the last of its block
            x = _pool(x, last)
            yield f"pool{name[4]}", x if last else np.moveaxis(x, 0, -1)


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
