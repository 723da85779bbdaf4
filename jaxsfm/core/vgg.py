"""VGG-16 and VGG-19 up to the pooling of conv5, as flax modules with the canonical layer names.

Images may be padded at the bottom and on the right. After every convolution the rows and columns
beyond the valid size are set to zero again. The borders of the network use zero padding, so the
valid part of a map equals the map of the unpadded image. Pooling rounds sizes down, as in
MatConvNet and PyTorch.

Source: Simonyan and Zisserman 2015, configurations D and E.
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxsfm.core.blocks import Layer, clear_padding, convolve, pool, scores_and_pool
from jaxsfm.core.pair_shape import FINE_STRIDES, PAPER_LAYERS, Layers
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
"""The numbers of channels of the convolutions of VGG-16, block by block."""
BLOCKS_19: Blocks = tuple((*block, block[-1]) if len(block) == 3 else block for block in BLOCKS)
"""The same of VGG-19, which has one more convolution in each of the last three blocks."""


def layers_of(blocks: Blocks) -> dict[str, tuple[int, int]]:
    """Layer name -> (input channels, output channels)."""
    layers, channels = {}, 3
    for block, widths in enumerate(blocks, start=1):
        for conv, width in enumerate(widths, start=1):
            layers[f"conv{block}_{conv}"] = (channels, width)
            channels = width
    return layers


LAYERS = layers_of(BLOCKS)
"""The layers of VGG-16."""

LARGE_BLOCKS = 2
"""Number of first blocks that CPUs compute strip by strip. The third block gains nothing by it."""


class Preprocessing(NamedTuple):
    """The input that a family of weights expects: (image / scale - mean) / std, channels RGB."""

    scale: float
    mean: tuple[float, float, float]
    std: tuple[float, float, float]


def preprocess(
    image: UInt8[Array, "*b h w 3"] | Float[Array, "*b h w 3"], p: Preprocessing
) -> Float[Array, "*b h w 3"]:
    """The input of the network for an RGB image, 0 .. 255."""
    x = image.astype(jnp.float32) / p.scale
    return (x - jnp.asarray(p.mean, jnp.float32)) / jnp.asarray(p.std, jnp.float32)


class Parameters(nn.Module):
    """The parameters of a layer under their canonical names."""

    inputs: int
    features: int

    @nn.compact
    def __call__(self) -> Layer:
        """The kernel and the bias."""
        shape = (3, 3, self.inputs, self.features)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape, jnp.float32)
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,), jnp.float32)
        return Layer(jnp.asarray(kernel), jnp.asarray(bias))


class VGG(nn.Module):
    """A flax module: `apply(params, images, size)` gives a `Pyramid`, all maps up to pool5.

    With `method="levels"` it gives `Levels`, the maps that features are made of. The largest maps
    then do not exist as a whole.
    """

    blocks: ClassVar[Blocks]
    bfloat16: bool = False
    """Convolutions round to bfloat16 (`jaxsfm.core.blocks.conv`)."""

    def setup(self) -> None:
        """Make all layers, with their canonical names."""
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
        *,
        layers: Layers = PAPER_LAYERS,
    ) -> Levels:
        """The maps that features are made of. Arguments are those of `__call__`.

        Args:
          heads: learned heads for the scores of conv1_2, pool1 and pool2; `None` gives norms.
          layers: the coarse and the fine layer. Maps of convolutions are those before the
            rectifier; in VGG-19 they are the last ones of their blocks.
        """
        coarse, fine = layers.split("/")
        x = clear_padding(images, size)
        finest: list[Array] = []
        maps: dict[str, Array] = {}
        for block in range(1, int(coarse[4]) + 1):
            convs = self._layers(block)
            if block <= LARGE_BLOCKS:
                head = heads[0] if block == 1 else None
                scored, x = scores_and_pool(
                    x, size, convs, large=True, head=head, bfloat16=self.bfloat16
                )
                finest.append(scored)
            else:
                maps[f"conv{block}_3"] = convolve(x, size, convs, bfloat16=self.bfloat16)
                x = pool(maps[f"conv{block}_3"], size)
            maps[f"pool{block}"] = x
            size = size // 2
        walked = [finest[0]]
        for k in range(1, FINE_STRIDES[layers].bit_length() - 1):
            walked.append(score(maps[f"pool{k}"], heads[k] if k < len(heads) else None))
        return Levels(tuple(walked), maps[fine], maps[coarse])

    def conv5(
        self, images: Float[Array, "b h w 3"], size: Int[Array, "b 2"]
    ) -> Float[Array, "b h16 w16 512"]:
        """The last convolution before its rectifier, zero beyond the valid cells. Arguments are
        those of `__call__`."""
        x = clear_padding(images, size)
        for block in range(1, 5):
            layers, large = self._layers(block), block <= LARGE_BLOCKS
            _, x = scores_and_pool(x, size, layers, large=large, bfloat16=self.bfloat16)
            size = size // 2
        return convolve(x, size, self._layers(5), bfloat16=self.bfloat16)

    def walked(
        self, images: Float[Array, "b h w 3"], size: Int[Array, "b 2"]
    ) -> tuple[Float[Array, "b h w 64"], Float[Array, "b h2 w2 64"], Float[Array, "b h4 w4 128"]]:
        """The maps that keypoints walk through: conv1_2, pool1 and pool2. Arguments are those of
        `__call__`."""
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
    """The shapes of the parameters: {'params': {layer: {'kernel': HWIO, 'bias': O}}}."""
    return jax.eval_shape(
        VGG16().init,
        jax.random.key(0),
        jax.ShapeDtypeStruct((1, 32, 32, 3), jnp.float32),
        jax.ShapeDtypeStruct((1, 2), jnp.int32),
    )
