"""VGG-16 up to the pooling of conv5, as a flax module with the canonical layer names.

Images may be padded at the bottom and on the right: after every convolution the rows and columns
past the valid size are set to zero again, so that the valid part equals what the unpadded image
gives (zero padding is what the network's own borders use). Pooling floors, as MatConvNet and
PyTorch do.

Source: Simonyan and Zisserman 2015, configuration D.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, UInt8

from jaxsfm.core.numerics import HIGHEST, squared_norm
from jaxsfm.core.types import Levels, Pyramid
from jaxsfm.core.winograd import conv3x3

BLOCKS: tuple[tuple[int, ...], ...] = (
    (64, 64),
    (128, 128),
    (256, 256, 256),
    (512, 512, 512),
    (512, 512, 512),
)
LAYERS: dict[str, tuple[int, int]] = {}
"""Layer name -> (input channels, output channels)."""
_channels = 3
for _block, _widths in enumerate(BLOCKS, start=1):
    for _conv, _width in enumerate(_widths, start=1):
        LAYERS[f"conv{_block}_{_conv}"] = (_channels, _width)
        _channels = _width


class Preprocessing(NamedTuple):
    """What a family of weights expects: (image / scale - mean) / std, channels RGB."""

    scale: float
    mean: tuple[float, float, float]
    std: tuple[float, float, float]


def preprocess(image: UInt8[Array, "*b h w 3"], p: Preprocessing) -> Float[Array, "*b h w 3"]:
    """RGB bytes to the network's input."""
    x = image.astype(jnp.float32) / p.scale
    return (x - jnp.asarray(p.mean, jnp.float32)) / jnp.asarray(p.std, jnp.float32)


def _clear_padding(x: Float[Array, "b h w c"], size: Int[Array, "b 2"]) -> Array:
    rows = lax.broadcasted_iota(jnp.int32, x.shape[:3], 1) < size[:, 0, None, None]
    cols = lax.broadcasted_iota(jnp.int32, x.shape[:3], 2) < size[:, 1, None, None]
    return jnp.where((rows & cols)[..., None], x, 0.0)


WINOGRAD_CHANNELS = 256
"""Input channels from which Winograd's transforms cost less than they save on CPUs."""
WINOGRAD_PIXELS = 1 << 13
"""Of a map, from which it is worth compiling: a second for each layer."""
STRIP_BLOCKS = 2
"""Blocks that CPUs compute strip by strip: the largest maps, far beyond any cache."""
STRIP_ROWS = 16
"""Of a block's input, even; 8 to 32 take the same time, 128 a fifth more."""


class Layer(NamedTuple):
    """One convolution."""

    kernel: Float[Array, "3 3 c o"]
    bias: Float[Array, " o"]


class Parameters(nn.Module):
    """Holds a layer's parameters under the canonical names."""

    inputs: int
    features: int

    @nn.compact
    def __call__(self) -> Layer:
        """The layer."""
        shape = (3, 3, self.inputs, self.features)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        return Layer(jnp.asarray(kernel), jnp.asarray(bias))


def _library(
    x: Float[Array, "b h w c"], kernel: Array, *, bfloat16: bool, rows: int = 1
) -> Float[Array, "b _h w o"]:
    """The backend's own convolution; `rows` of zeros are added above and below."""
    if bfloat16:
        x, kernel = x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16)
    return lax.conv_general_dilated(
        x,
        kernel,
        (1, 1),
        ((rows, rows), (1, 1)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=HIGHEST,
        preferred_element_type=jnp.float32,
    )


def _rounded(x: Array, bfloat16: bool) -> Array:
    """As bfloat16 has it: CPUs multiply float32 and get what accelerators get."""
    return lax.reduce_precision(x, exponent_bits=8, mantissa_bits=7) if bfloat16 else x


def conv(x: Float[Array, "b h w c"], layer: Layer, *, bfloat16: bool) -> Float[Array, "b h w o"]:
    """3 x 3 convolution with zero padding of one, plus bias: the fastest way of the platform
    compiled for."""
    height, width, channels = x.shape[1:]
    small = channels < WINOGRAD_CHANNELS or height * width < WINOGRAD_PIXELS

    def on_cpu(x, kernel):
        x, kernel = _rounded(x, bfloat16), _rounded(kernel, bfloat16)
        if small:
            return _library(x, kernel, bfloat16=False)
        return lax.map(lambda image: conv3x3(image, kernel), x)

    elsewhere = functools.partial(_library, bfloat16=bfloat16)
    if small and not bfloat16:
        return elsewhere(x, layer.kernel) + layer.bias
    return lax.platform_dependent(x, layer.kernel, cpu=on_cpu, default=elsewhere) + layer.bias


def _pool(x: Float[Array, "b h w c"], size: Int[Array, "b 2"]) -> Float[Array, "b h2 w2 c"]:
    """Rectified, and the largest of 2 x 2; zero past half of `size`."""
    # An odd last row is pooled with padding; a floor pooling has no such cell.
    return _clear_padding(nn.max_pool(nn.relu(x), (2, 2), strides=(2, 2)), size // 2)


def _convolved(
    x: Float[Array, "b h w c"],
    size: Int[Array, "b 2"],
    layers: Sequence[Layer],
    *,
    bfloat16: bool,
) -> list[Float[Array, "b h w _o"]]:
    """The convolutions of a block before their rectifiers."""
    maps: list[Array] = []
    for layer in layers:
        x = _clear_padding(conv(nn.relu(maps[-1]) if maps else x, layer, bfloat16=bfloat16), size)
        maps.append(x)
    return maps


def _strips(
    x: Float[Array, "h w c"], size: Int[Array, " 2"], layers: Sequence[Layer], *, bfloat16: bool
) -> tuple[Float[Array, "h w"], Float[Array, "h2 w2 o"]]:
    """Squared norms of a block's last convolution and its pooled map, STRIP_ROWS at a time: with
    a row more on either side for every layer, nothing else of the maps ever exists."""
    height, width, depth = *x.shape[:2], len(layers)
    rows = min(STRIP_ROWS, height)
    strips = -(-height // rows)
    padded = jnp.pad(x, ((depth, depth + strips * rows - height), (0, 0), (0, 0)))
    columns = jnp.arange(width) < size[1]

    def strip(start):
        y = lax.dynamic_slice_in_dim(padded, start, rows + 2 * depth)[None]
        for margin, layer in zip(reversed(range(depth)), layers, strict=True):
            y = _rounded(nn.relu(y) if margin + 1 < depth else y, bfloat16)
            y = _library(y, _rounded(layer.kernel, bfloat16), bfloat16=False, rows=0)
            row = start - margin + jnp.arange(rows + 2 * margin)
            inside = ((row >= 0) & (row < size[0]))[:, None] & columns
            y = jnp.where(inside[:, :, None], y + layer.bias, 0.0)
        return squared_norm(y[0]), nn.max_pool(nn.relu(y), (2, 2), strides=(2, 2))[0]

    norms, pooled = lax.map(strip, rows * jnp.arange(strips))
    pooled = pooled.reshape(1, strips * rows // 2, width // 2, -1)[:, : height // 2]
    return norms.reshape(-1, width)[:height], _clear_padding(pooled, size[None] // 2)[0]


class VGG16(nn.Module):
    """`apply(params, images, size)` -> Pyramid; pure.

    With `method="levels"` -> Levels: what features are made of, without the largest maps.
    """

    bfloat16: bool = False
    """Convolutions multiply in bfloat16 and add in float32."""

    def setup(self) -> None:
        """Thirteen layers with the canonical names."""
        for name, shape in LAYERS.items():
            setattr(self, name, Parameters(*shape))

    def _layers(self, block: int) -> list[Layer]:
        return [getattr(self, f"conv{block}_{k + 1}")() for k in range(len(BLOCKS[block - 1]))]

    def __call__(self, images: Float[Array, "b h w 3"], size: Int[Array, "b 2"]) -> Pyramid:
        """Feature maps of preprocessed images.

        Args:
          images: network input, zero past `size`.
          size: valid (rows, columns) of each image; (h, w) when nothing is padded.
        """
        x = _clear_padding(images, size)
        maps: list[Array] = []
        for block in range(1, len(BLOCKS) + 1):
            last = _convolved(x, size, self._layers(block), bfloat16=self.bfloat16)[-1]
            if block == 1:
                maps.append(last)
            x = _pool(last, size)
            size = size // 2
            maps.append(x)
        return Pyramid(*maps)

    def levels(self, images: Float[Array, "b h w 3"], size: Int[Array, "b 2"]) -> Levels:
        """The same network up to pool4; arguments as above."""
        x = _clear_padding(images, size)
        norms: list[Array] = []
        pooled: list[Array] = []
        for block in range(1, 5):
            layers = self._layers(block)

            def whole(x, size, layers):
                last = _convolved(x, size, layers, bfloat16=self.bfloat16)[-1]
                return squared_norm(last), _pool(last, size)

            def strips(x, size, layers):
                one = functools.partial(_strips, layers=layers, bfloat16=self.bfloat16)
                return lax.map(lambda item: one(*item), (x, size))

            if block <= STRIP_BLOCKS:
                norm, x = lax.platform_dependent(x, size, layers, cpu=strips, default=whole)
            else:
                norm, x = whole(x, size, layers)
            norms.append(norm)
            pooled.append(x)
            size = size // 2
        pool1, pool2, pool3, pool4 = pooled
        return Levels((norms[0], squared_norm(pool1), squared_norm(pool2)), pool3, pool4)


def init_shapes() -> dict:
    """The parameter tree's shapes: {'params': {layer: {'kernel': HWIO, 'bias': O}}}."""
    return jax.eval_shape(
        VGG16().init,
        jax.random.key(0),
        jax.ShapeDtypeStruct((1, 32, 32, 3), jnp.float32),
        jax.ShapeDtypeStruct((1, 2), jnp.int32),
    )
