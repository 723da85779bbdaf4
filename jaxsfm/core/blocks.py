"""A block of the network: 3 x 3 convolutions, each rectified, and then a 2 x 2 maximum pooling.

On CPUs the large maps are computed strip by strip, and the deep ones by Winograd's convolution. On
accelerators the convolutions of the library are applied to whole maps. After every layer, the cells
beyond the valid size of an image are set to zero, so that the valid part equals the maps of the
unpadded image.
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

WINOGRAD_CHANNELS = 128
"""Number of input channels from which Winograd's convolution is faster on CPUs."""
WINOGRAD_PRODUCTS = 1 << 29
"""Number of products (pixels x input channels x outputs) from which it is used. For less, the half
second that each layer takes to compile is not worth the gain."""
STRIP_ROWS = 16
"""Rows of the input of a block that are computed at once; even. 8 to 32 rows take the same time,
128 rows a fifth more."""


class Layer(NamedTuple):
    """One convolution."""

    kernel: Float[Array, "3 3 c o"]
    bias: Float[Array, " o"]


def clear_padding(x: Float[Array, "b h w c"], size: Int[Array, "b 2"]) -> Float[Array, "b h w c"]:
    """The maps with zeros beyond the valid (rows, columns) of each image."""
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
    """x rounded to the precision of bfloat16, as float32: on CPUs products of float32 then equal
    those of bfloat16 on accelerators."""
    return lax.reduce_precision(x, exponent_bits=8, mantissa_bits=7) if bfloat16 else x


def conv(
    x: Float[Array, "b h w c"], layer: Layer, *, bfloat16: bool = False
) -> Float[Array, "b h w o"]:
    """3 x 3 convolution with zero padding of one cell, plus bias.

    Args:
      bfloat16: operands are rounded to bfloat16 and their products summed in float32. The sums are
        rounded to bfloat16 before the bias is added.
    """
    height, width, channels = x.shape[1:]
    products = height * width * channels * layer.kernel.shape[3]
    small = channels < WINOGRAD_CHANNELS or products < WINOGRAD_PRODUCTS

    def on_cpu(x, kernel):
        x, kernel = rounded(x, bfloat16), rounded(kernel, bfloat16)
        if small:
            return rounded(_library(x, kernel), bfloat16)
        return rounded(lax.map(lambda image: conv3x3(image, kernel), x), bfloat16)

    def elsewhere(x, kernel):
        if not bfloat16:
            return _library(x, kernel)
        # Operands and result have one type, because XLA has no mixed convolution for GPUs.
        return _library(x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16)).astype(x.dtype)

    if small and not bfloat16:
        return _library(x, layer.kernel) + layer.bias
    return platform_dependent(x, layer.kernel, cpu=on_cpu, default=elsewhere) + layer.bias


def pool(x: Float[Array, "b h w c"], size: Int[Array, "b 2"]) -> Float[Array, "b h2 w2 c"]:
    """The rectified maximum of 2 x 2 cells, stride 2; zero beyond half of `size`."""
    # An odd last row was pooled with padding. Pooling that rounds down has no such cell.
    return clear_padding(nn.max_pool(nn.relu(x), (2, 2), strides=(2, 2)), size // 2)


def convolve(
    x: Float[Array, "b h w c"],
    size: Int[Array, "b 2"],
    layers: Sequence[Layer],
    *,
    bfloat16: bool = False,
) -> Float[Array, "b h w o"]:
    """The last convolution of a block, before its rectifier."""
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
    """The scores of the last convolution of a block, and its pooled map.

    Args:
      large: the maps of the block exceed any cache, so CPUs compute them strip by strip.
      head: the learned head of the scores; `None` gives squared norms.
      bfloat16: as in `conv`.
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
    """The scores and the pooled map of one image, STRIP_ROWS at a time.

    A strip is computed with one more row on either side for every layer that follows. The maps
    never exist as a whole.
    """
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
