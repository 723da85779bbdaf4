"""The networks that features can be made of.

A backbone is a flax module with a method `levels(images, size, heads)` that returns `Levels`: score
maps of strides 1, 2 and 4, which keypoints walk down, and descriptors of strides 8 and 16. Later
stages do not depend on which network it was (docs/guide/backbones.md).
"""

from typing import NamedTuple

import flax.linen as nn

from jaxsfm.core import alexnet
from jaxsfm.core.vgg import BLOCKS, BLOCKS_19, VGG16, VGG19, Blocks, layers_of


class Backbone(NamedTuple):
    """A network and its shapes."""

    module: type[nn.Module]
    """The flax module; its constructor takes `bfloat16`."""
    kernels: dict[str, tuple[int, int, int, int]]
    """Layer name -> HWIO shape of its kernel. The parameters of a layer are `kernel` and `bias`."""
    fine: int
    """Number of channels of the descriptors of stride 8."""
    coarse: int
    """Number of channels of the descriptors of stride 16."""
    learned: bool
    """Whether relocalizers can be learned for its maps."""


def _vgg(module: type[nn.Module], blocks: Blocks, *, learned: bool) -> Backbone:
    kernels = {name: (3, 3, *channels) for name, channels in layers_of(blocks).items()}
    return Backbone(module, kernels, fine=blocks[2][-1], coarse=blocks[3][-1], learned=learned)


BACKBONES: dict[str, Backbone] = {
    "vgg16": _vgg(VGG16, BLOCKS, learned=True),
    "vgg19": _vgg(VGG19, BLOCKS_19, learned=False),
    "alexnet": Backbone(alexnet.AlexNet, alexnet.KERNELS, fine=192, coarse=256, learned=False),
}
