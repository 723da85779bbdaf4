"""VGG-16 up to the pooling of conv5, as a flax module with the canonical layer names.

Images may be padded at the bottom and on the right: after every convolution the rows and columns
past the valid size are set to zero again, so that the valid part equals what the unpadded image
gives (zero padding is what the network's own borders use). Pooling floors, as MatConvNet and
PyTorch do.

Source: Simonyan and Zisserman 2015, configuration D.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, UInt8

from jaxsfm.core.numerics import HIGHEST
from jaxsfm.core.types import Pyramid
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


class Conv(nn.Module):
    """3 x 3 convolution with zero padding of one, the fastest way of the platform compiled for."""

    features: int
    precision: lax.Precision

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w o"]:
        """The maps plus bias."""
        shape = (3, 3, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))

        def library(x, kernel):
            axes = ("NHWC", "HWIO", "NHWC")
            return lax.conv_general_dilated(
                x, kernel, (1, 1), "SAME", dimension_numbers=axes, precision=self.precision
            )

        def winograd(x, kernel):
            return lax.map(lambda image: conv3x3(image, jnp.asarray(kernel)), x)

        height, width, channels = x.shape[1:]
        if channels < WINOGRAD_CHANNELS or height * width < WINOGRAD_PIXELS:
            return library(x, kernel) + bias
        return lax.platform_dependent(x, kernel, cpu=winograd, default=library) + bias


class VGG16(nn.Module):
    """`apply(params, images, size)` -> Pyramid; pure."""

    precision: lax.Precision = HIGHEST

    @nn.compact
    def __call__(self, images: Float[Array, "b h w 3"], size: Int[Array, "b 2"]) -> Pyramid:
        """Feature maps of preprocessed images.

        Args:
          images: network input, zero past `size`.
          size: valid (rows, columns) of each image; (h, w) when nothing is padded.
        """
        x = _clear_padding(images, size)
        maps: list[Array] = []
        for block, widths in enumerate(BLOCKS, start=1):
            for conv, width in enumerate(widths, start=1):
                x = Conv(width, self.precision, name=f"conv{block}_{conv}")(x)
                x = _clear_padding(x, size)
                if (block, conv) == (1, 2):
                    maps.append(x)
                x = nn.relu(x)
            x = nn.max_pool(x, (2, 2), strides=(2, 2))
            size = size // 2
            # An odd last row is pooled with padding; a floor pooling has no such cell.
            x = _clear_padding(x, size)
            maps.append(x)
        return Pyramid(*maps)


def init_shapes() -> dict:
    """The parameter tree's shapes: {'params': {layer: {'kernel': HWIO, 'bias': O}}}."""
    return jax.eval_shape(
        VGG16().init,
        jax.random.key(0),
        jax.ShapeDtypeStruct((1, 32, 32, 3), jnp.float32),
        jax.ShapeDtypeStruct((1, 2), jnp.int32),
    )
