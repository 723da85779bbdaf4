"""VGG-16 in numpy and float64, in the convention of the weights' own framework.

This network is independent of jaxsfm's network and of the conversion, so the two can be compared.
Images and kernels stay as the framework has them: channels first or last, BGR or RGB, convolution
or correlation. Each tap of a kernel is added separately, which is slow; images should be small.
"""

from collections.abc import Iterator

import numpy as np

from weights_conversion.source import Source


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
