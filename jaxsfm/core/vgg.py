"""VGG-16 and VGG-19 up to the pooling of conv5, as flax modules with the canonical layer names.

Images may be padded at the bottom and on the right: after every convolution the rows and columns
past the valid size are set to zero again, so that the valid part equals what the unpadded image
gives (zero padding is what the network's own borders use). Pooling floors, as MatConvNet and
PyTorch do.

Source: Simonyan and Zisserman 2015, configurations D and E.
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxsfm.core.blocks import Layer, clear_padding, convolve, pool, scores_and_pool
from jaxsfm.core.scores import Head, score
from jaxsfm.core.types import Levels, Pyramid

Blocks = tuple[tuple[int, ...], ...]
BLOCKS: Blocks = (
    (64, 64),
    (128, 128),
    (256, 256, 256),
    (512, 512, 512),
    (512, 512, 512),
)
"""Of VGG-16: the channels of every convolution of every block."""
BLOCKS_19: Blocks = tuple((*block, block[-1]) if len(block) == 3 else block for block in BLOCKS)
"""Of VGG-19: a convolution more in each of the last three."""


def layers_of(blocks: Blocks) -> dict[str, tuple[int, int]]:
    """Layer name -> (input channels, output channels)."""
    layers, channels = {}, 3
    for block, widths in enumerate(blocks, start=1):
        for conv, width in enumerate(widths, start=1):
            layers[f"conv{block}_{conv}"] = (channels, width)
            channels = width
    return layers


LAYERS = layers_of(BLOCKS)
"""Of VGG-16."""

LARGE_BLOCKS = 2
"""Those whose maps CPUs compute strip by strip; the third gains nothing."""


class Preprocessing(NamedTuple):
    """What a family of weights expects: (image / scale - mean) / std, channels RGB."""

    scale: float
    mean: tuple[float, float, float]
    std: tuple[float, float, float]


def preprocess(
    image: UInt8[Array, "*b h w 3"] | Float[Array, "*b h w 3"], p: Preprocessing
) -> Float[Array, "*b h w 3"]:
    """RGB, 0 .. 255, to the network's input."""
    x = image.astype(jnp.float32) / p.scale
    return (x - jnp.asarray(p.mean, jnp.float32)) / jnp.asarray(p.std, jnp.float32)


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


class VGG(nn.Module):
    """`apply(params, images, size)` -> Pyramid, all maps up to pool5; pure.

    With `method="levels"` -> Levels: what features are made of, without the largest maps.
    """

    blocks: ClassVar[Blocks]
    bfloat16: bool = False
    """Convolutions of bfloat16 (`jaxsfm.core.blocks.conv`)."""

    def setup(self) -> None:
        """All layers, with the canonical names."""
        for name, shape in layers_of(self.blocks).items():
            setattr(self, name, Parameters(*shape))

    def _layers(self, block: int) -> list[Layer]:
        count = len(self.blocks[block - 1])
        return [getattr(self, f"conv{block}_{k + 1}")() for k in range(count)]

    def __call__(self, images: Float[Array, "b h w 3"], size: Int[Array, "b 2"]) -> Pyramid:
        """Feature maps of preprocessed images.

        Args:
          images: network input, zero past `size`.
          size: valid (rows, columns) of each image; (h, w) when nothing is padded.
        """
        x = clear_padding(images, size)
        maps: list[Array] = []
        for block in range(1, len(self.blocks) + 1):
            last = convolve(x, size, self._layers(block), bfloat16=self.bfloat16)
            if block == 1:
                maps.append(last)
            x = pool(last, size)
            size = size // 2
            maps.append(x)
        return Pyramid(*maps)

    def levels(
        self,
        images: Float[Array, "b h w 3"],
        size: Int[Array, "b 2"],
        heads: Sequence[Head | None] = (None, None, None),
    ) -> Levels:
        """The same network up to pool4; arguments as above.

        Args:
          heads: of the scores of conv1_2, pool1 and pool2; None: squared norms.
        """
        x = clear_padding(images, size)
        finest: list[Array] = []
        pooled: list[Array] = []
        for block in range(1, 5):
            scored, x = scores_and_pool(
                x,
                size,
                self._layers(block),
                large=block <= LARGE_BLOCKS,
                head=heads[0] if block == 1 else None,
                bfloat16=self.bfloat16,
            )
            finest.append(scored)
            pooled.append(x)
            size = size // 2
        pool1, pool2, pool3, pool4 = pooled
        scores = (finest[0], score(pool1, heads[1]), score(pool2, heads[2]))
        return Levels(scores, pool3, pool4)

    def conv5(
        self, images: Float[Array, "b h w 3"], size: Int[Array, "b 2"]
    ) -> Float[Array, "b h16 w16 512"]:
        """The last convolution before its rectifier, zero past the valid cells; arguments as
        above."""
        x = clear_padding(images, size)
        for block in range(1, 5):
            layers, large = self._layers(block), block <= LARGE_BLOCKS
            _, x = scores_and_pool(x, size, layers, large=large, bfloat16=self.bfloat16)
            size = size // 2
        return convolve(x, size, self._layers(5), bfloat16=self.bfloat16)

    def walked(
        self, images: Float[Array, "b h w 3"], size: Int[Array, "b 2"]
    ) -> tuple[Float[Array, "b h w 64"], Float[Array, "b h2 w2 64"], Float[Array, "b h4 w4 128"]]:
        """The maps that keypoints walk through, conv1_2, pool1 and pool2; arguments as above."""
        x = clear_padding(images, size)
        conv1_2 = convolve(x, size, self._layers(1), bfloat16=self.bfloat16)
        pool1 = pool(conv1_2, size)
        size = size // 2
        pool2 = pool(convolve(pool1, size, self._layers(2), bfloat16=self.bfloat16), size)
        return conv1_2, pool1, pool2


class VGG16(VGG):
    """Thirteen convolutions."""

    blocks = BLOCKS


class VGG19(VGG):
    """Sixteen convolutions."""

    blocks = BLOCKS_19


def init_shapes() -> dict:
    """The parameter tree's shapes: {'params': {layer: {'kernel': HWIO, 'bias': O}}}."""
    return jax.eval_shape(
        VGG16().init,
        jax.random.key(0),
        jax.ShapeDtypeStruct((1, 32, 32, 3), jnp.float32),
        jax.ShapeDtypeStruct((1, 2), jnp.int32),
    )
