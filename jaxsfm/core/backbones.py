"""The networks that features can be made of.

A backbone is a flax module whose method `levels(images, size, heads)` gives `Levels`: score maps of
strides 1, 2 and 4 that keypoints walk down, descriptors of strides 8 and 16. Nothing after it knows
which network it was (docs/guide/backbones.md).
"""

from typing import NamedTuple

import flax.linen as nn

from jaxsfm.core import alexnet
from jaxsfm.core.vgg import BLOCKS, BLOCKS_19, VGG16, VGG19, Blocks, layers_of


class Backbone(NamedTuple):
    """One network."""

    module: type[nn.Module]
    """Called with `bfloat16`."""
    kernels: dict[str, tuple[int, int, int, int]]
    """Layer -> HWIO shape of its kernel; a layer's parameters are `kernel` and `bias`."""
    fine: int
    """Channels of the descriptors of stride 8."""
    coarse: int
    """Channels of the descriptors of stride 16."""
    learned: bool
    """Whether there are learned scores for its maps."""


def _vgg(module: type[nn.Module], blocks: Blocks, *, learned: bool) -> Backbone:
    kernels = {name: (3, 3, *channels) for name, channels in layers_of(blocks).items()}
    return Backbone(module, kernels, fine=blocks[2][-1], coarse=blocks[3][-1], learned=learned)


BACKBONES: dict[str, Backbone] = {
    "vgg16": _vgg(VGG16, BLOCKS, learned=True),
    "vgg19": _vgg(VGG19, BLOCKS_19, learned=False),
    "alexnet": Backbone(alexnet.AlexNet, alexnet.KERNELS, fine=192, coarse=256, learned=False),
}
