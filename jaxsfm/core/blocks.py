"""A block of the network: 3 x 3 convolutions, each rectified, then the largest of 2 x 2.

On CPUs the large maps are computed strip by strip and the deep ones by Winograd's convolution;
elsewhere the library's convolutions see whole maps. What is past an image's valid size is set to
zero after every layer, so that the valid part equals what the unpadded image gives.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax import lax
from jax.lax import platform_dependent
from jaxtyping import Array, Float, Int

from jaxsfm.core.numerics import HIGHEST
from jaxsfm.core.scores import Head, score
from jaxsfm.core.winograd import conv3x3

WINOGRAD_CHANNELS = 256
"""Input channels from which Winograd's transforms cost less than they save on CPUs."""
WINOGRAD_PIXELS = 1 << 13
"""Of a map, from which it is worth compiling: a second for each layer."""
STRIP_ROWS = 16
"""Of a block's input, even; 8 to 32 take the same time, 128 a fifth more."""


class Layer(NamedTuple):
    """One convolution."""

    kernel: Float[Array, "3 3 c o"]
    bias: Float[Array, " o"]


def clear_padding(x: Float[Array, "b h w c"], size: Int[Array, "b 2"]) -> Float[Array, "b h w c"]:
    """Zero past the valid (rows, columns) of each image."""
    rows = lax.broadcasted_iota(jnp.int32, x.shape[:3], 1) < size[:, 0, None, None]
    cols = lax.broadcasted_iota(jnp.int32, x.shape[:3], 2) < size[:, 1, None, None]
    return jnp.where((rows & cols)[..., None], x, 0.0)


def _library(
    x: Float[Array, "b h w c"], kernel: Array, *, rows: int = 1
) -> Float[Array, "b _h w o"]:
    """The backend's own convolution; `rows` of zeros are added above and below."""
    return lax.conv_general_dilated(
        x,
        kernel,
        (1, 1),
        ((rows, rows), (1, 1)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=HIGHEST,
    )


def rounded(x: Array, bfloat16: bool) -> Array:
    """As bfloat16 has it: CPUs multiply float32 and get what accelerators get."""
    return lax.reduce_precision(x, exponent_bits=8, mantissa_bits=7) if bfloat16 else x


def conv(
    x: Float[Array, "b h w c"], layer: Layer, *, bfloat16: bool = False
) -> Float[Array, "b h w o"]:
    """3 x 3 convolution with zero padding of one, plus bias.

    Args:
      bfloat16: products of bfloat16, summed in float32, rounded, before the bias is added.
    """
    height, width, channels = x.shape[1:]
    small = channels < WINOGRAD_CHANNELS or height * width < WINOGRAD_PIXELS

    def on_cpu(x, kernel):
        x, kernel = rounded(x, bfloat16), rounded(kernel, bfloat16)
        if small:
            return rounded(_library(x, kernel), bfloat16)
        return rounded(lax.map(lambda image: conv3x3(image, kernel), x), bfloat16)

    def elsewhere(x, kernel):
        if not bfloat16:
            return _library(x, kernel)
        # Operands and result of one type: XLA has no mixed convolution for GPUs.
        return _library(x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16)).astype(x.dtype)

    if small and not bfloat16:
        return _library(x, layer.kernel) + layer.bias
    return platform_dependent(x, layer.kernel, cpu=on_cpu, default=elsewhere) + layer.bias


def pool(x: Float[Array, "b h w c"], size: Int[Array, "b 2"]) -> Float[Array, "b h2 w2 c"]:
    """Rectified, and the largest of 2 x 2; zero past half of `size`."""
    # An odd last row is pooled with padding; a floor pooling has no such cell.
    return clear_padding(nn.max_pool(nn.relu(x), (2, 2), strides=(2, 2)), size // 2)


def convolve(
    x: Float[Array, "b h w c"],
    size: Int[Array, "b 2"],
    layers: Sequence[Layer],
    *,
    bfloat16: bool = False,
) -> Float[Array, "b h w o"]:
    """A block's last convolution, before its rectifier."""
    for k, layer in enumerate(layers):
        x = clear_padding(conv(nn.relu(x) if k else x, layer, bfloat16=bfloat16), size)
    return x


def scores_and_pool(
    x: Float[Array, "b h w c"],
    size: Int[Array, "b 2"],
    layers: Sequence[Layer],
    *,
    large: bool,
    head: Head | None = None,
    bfloat16: bool = False,
) -> tuple[Float[Array, "b h w"], Float[Array, "b h2 w2 o"]]:
    """Scores of a block's last convolution, and its pooled map.

    Args:
      head: of the score; None: squared norms.
      large: the block's maps are far beyond any cache: CPUs compute them strip by strip.
    """

    def whole(x, size, layers, head):
        last = convolve(x, size, layers, bfloat16=bfloat16)
        return score(last, head), pool(last, size)

    def strips(x, size, layers, head):
        one = functools.partial(_strips, layers=layers, head=head, bfloat16=bfloat16)
        return lax.map(lambda item: one(*item), (x, size))

    if large:
        return platform_dependent(x, size, layers, head, cpu=strips, default=whole)
    return whole(x, size, layers, head)


def _strips(
    x: Float[Array, "h w c"],
    size: Int[Array, " 2"],
    layers: Sequence[Layer],
    *,
    head: Head | None,
    bfloat16: bool,
) -> tuple[Float[Array, "h w"], Float[Array, "h2 w2 o"]]:
    """Scores of a block's last convolution and its pooled map, STRIP_ROWS at a time: with a row
    more on either side for every layer, nothing else of the maps ever exists."""
    height, width, depth = *x.shape[:2], len(layers)
    rows = min(STRIP_ROWS, height)
    strips = -(-height // rows)
    padded = jnp.pad(x, ((depth, depth + strips * rows - height), (0, 0), (0, 0)))
    columns = jnp.arange(width, dtype=jnp.int32) < size[1]

    def strip(start):
        y = lax.dynamic_slice_in_dim(padded, start, rows + 2 * depth)[None]
        for margin, layer in zip(reversed(range(depth)), layers, strict=True):
            y = rounded(nn.relu(y) if margin + 1 < depth else y, bfloat16)
            y = rounded(_library(y, rounded(layer.kernel, bfloat16), rows=0), bfloat16)
            row = start - margin + jnp.arange(rows + 2 * margin, dtype=jnp.int32)
            inside = ((row >= 0) & (row < size[0]))[:, None] & columns
            y = jnp.where(inside[:, :, None], y + layer.bias, 0.0)
        return score(y[0], head), nn.max_pool(nn.relu(y), (2, 2), strides=(2, 2))[0]

    scores, pooled = lax.map(strip, rows * jnp.arange(strips, dtype=jnp.int32))
    pooled = pooled.reshape(1, strips * rows // 2, width // 2, -1)[:, : height // 2]
    return scores.reshape(-1, width)[:height], clear_padding(pooled, size[None] // 2)[0]
