"""AlexNet as a backbone: a network that is shallower than VGG and has other strides.

Its first convolution looks at 11 x 11 pixels in steps of 4, so no map of the network is finer than
4 pixels. Keypoints walk through the same convolution in steps of 1 pixel, and through its maxima
over 2 x 2 and 4 x 4 pixels. The descriptors are the rectified maps of the network: conv2 (stride 8)
and conv5 (stride 16). Cells are centred at (u + 0.5) s - 0.5, within half a pixel for conv2 and 3.5
pixels before it for conv5, whose windows are three cells wide.

Padding is exact, as for VGG: every map is zero beyond the valid size of an image.

Source: Krizhevsky 2014, "One weird trick", in the version of torchvision.
"""

import functools
from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsfm.core.blocks import clear_padding, rounded
from jaxsfm.core.numerics import HIGHEST, squared_norm
from jaxsfm.core.scores import Head
from jaxsfm.core.types import Levels

KERNELS: dict[str, tuple[int, int, int, int]] = {
    "conv1": (11, 11, 3, 64),
    "conv2": (5, 5, 64, 192),
    "conv3": (3, 3, 192, 384),
    "conv4": (3, 3, 384, 256),
    "conv5": (3, 3, 256, 256),
}
STRIP_ROWS = 16
"""Rows of the image whose first convolution exists at every pixel at a time; a multiple of 4."""
BEFORE = 5
"""Rows and columns by which the first window of conv1 reaches beyond the image. Windows are centred
on pixels 4 i."""


class _Convolution(nn.Module):
    shape: tuple[int, int, int, int]

    @nn.compact
    def __call__(self) -> tuple[Array, Array]:
        """The kernel and the bias."""
        kernel = self.param("kernel", nn.initializers.lecun_normal(), self.shape, jnp.float32)
        bias = self.param("bias", nn.initializers.zeros_init(), self.shape[3:], jnp.float32)
        return jnp.asarray(kernel), jnp.asarray(bias)


class AlexNet(nn.Module):
    """A flax module: `apply(params, images, size, heads, method="levels")` gives `Levels`."""

    bfloat16: bool = False
    """Operands and results rounded to bfloat16; sums are float32."""

    def setup(self) -> None:
        """Make the five convolutions."""
        for name, shape in KERNELS.items():
            setattr(self, name, _Convolution(shape))

    def levels(
        self,
        images: Float[Array, "b h w 3"],
        size: Int[Array, "b 2"],
        heads: Sequence[Head | None] = (None, None, None),
    ) -> Levels:
        """The maps that features are made of.

        Args:
          images: network input, zero beyond `size`; sides are multiples of 16.
          size: valid (rows, columns) of each image.
          heads: all `None`, because learned scores exist for the maps of VGG only.

        Raises:
          ValueError: a head is given.
        """
        if any(head is not None for head in heads):
            raise ValueError("AlexNet has no learned scores: heads must be None")
        x = clear_padding(images, size)
        first = self.conv1()
        walked = functools.partial(_walked, layer=first, bfloat16=self.bfloat16)
        scores = lax.map(lambda item: walked(item[0], item[1]), (x, size))
        conv = functools.partial(_conv, bfloat16=self.bfloat16)
        grid = size // 4
        x = clear_padding(nn.relu(conv(x, first, pad=(BEFORE, 2), stride=4)), grid)
        grid = grid // 2
        # Windows are three wide, in steps of two, and centred on 2 j + 1.
        x = clear_padding(_pool(x, (0, 1)), grid)
        fine = x = clear_padding(nn.relu(conv(x, self.conv2(), pad=(2, 2))), grid)
        grid = grid // 2
        x = clear_padding(_pool(x, (1, 0)), grid)
        for layer in (self.conv3(), self.conv4(), self.conv5()):
            x = clear_padding(nn.relu(conv(x, layer, pad=(1, 1))), grid)
        return Levels(scores, fine, x)


def _conv(
    x: Float[Array, "b h w c"],
    layer: tuple[Array, Array],
    *,
    pad: tuple[int, int],
    stride: int = 1,
    bfloat16: bool,
) -> Float[Array, "b h2 w2 o"]:
    kernel, bias = (rounded(layer[0], bfloat16), layer[1])
    out = lax.conv_general_dilated(
        rounded(x, bfloat16),
        kernel,
        (stride, stride),
        (pad, pad),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=HIGHEST,
    )
    return rounded(out, bfloat16) + bias


def _pool(x: Float[Array, "b h w c"], pad: tuple[int, int]) -> Float[Array, "b h2 w2 c"]:
    """The maximum of 3 x 3 cells, in steps of two; x is rectified."""
    padded = jnp.pad(x, ((0, 0), pad, pad, (0, 0)))  # zeros change no maximum
    return nn.max_pool(padded, (3, 3), strides=(2, 2))


def _walked(
    image: Float[Array, "h w 3"],
    size: Int[Array, " 2"],
    *,
    layer: tuple[Array, Array],
    bfloat16: bool,
) -> tuple[Float[Array, "h w"], Float[Array, "h2 w2"], Float[Array, "h4 w4"]]:
    """Squared norms of conv1 at every pixel, before its rectifier (as for conv1_2 of VGG), and of
    its rectified maxima over 2 x 2 and 4 x 4 pixels.

    They are computed STRIP_ROWS at a time, because a single map takes 400 MB at full size.
    """
    height, width = image.shape[:2]
    kernel = layer[0].shape[0]
    rows = min(STRIP_ROWS, height)
    strips = -(-height // rows)
    below = kernel - 1 - BEFORE + strips * rows - height
    padded = jnp.pad(image, ((BEFORE, below), (BEFORE, kernel - 1 - BEFORE), (0, 0)))

    def strip(start):
        part = lax.dynamic_slice_in_dim(padded, start, rows + kernel - 1)
        x = _conv(part[None], layer, pad=(0, 0), bfloat16=bfloat16)
        inside = jnp.stack([size[0] - start, size[1]])[None]
        x = clear_padding(x, inside)
        maps = [x]
        for _ in range(2):
            inside = inside // 2
            x = clear_padding(nn.max_pool(nn.relu(x), (2, 2), strides=(2, 2)), inside)
            maps.append(x)
        return tuple(squared_norm(m[0]) for m in maps)

    found = lax.map(strip, rows * jnp.arange(strips, dtype=jnp.int32))
    one, two, four = (m.reshape(-1, m.shape[-1])[: height >> k] for k, m in enumerate(found))
    return one, two, four
