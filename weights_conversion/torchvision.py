"""Reads torchvision's vgg16 and vgg19: RGB in [0, 1], ImageNet statistics, OIHW kernels."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors

from jaxsfm.core.vgg import BLOCKS, BLOCKS_19, LAYERS, Blocks, layers_of
from jaxsfm.errors import UserError
from jaxsfm.io.weights import TORCHVISION
from jaxsfm.weights_conversion.source import Convention, Source, check_layers
from jaxsfm.weights_conversion.torch_files import read_tensors

CONVENTION = Convention(layout="OIHW", bgr=False, convolution=False)


def numbered(blocks: Blocks) -> dict[str, str]:
    """Map torchvision's modules to layers.

    The modules are numbered; convolutions, rectifiers and poolings are counted together.
    """
    modules, index = {}, 0
    for block, widths in enumerate(blocks, start=1):
        for conv in range(1, len(widths) + 1):
            modules[f"features.{index}"] = f"conv{block}_{conv}"
            index += 2
        index += 1
    return modules


NUMBERED = numbered(BLOCKS)
NUMBERED_19 = numbered(BLOCKS_19)
NAMES = [
    f"{module}.{part}" for module in {**NUMBERED, **NUMBERED_19} for part in ("weight", "bias")
]
LAST_19 = f"{list(NUMBERED_19)[-1]}.weight"
"""A tensor that only VGG-19 has."""


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name) for name in set(NAMES) & set(file.keys())}
    except Exception as error:  # a damaged file can raise more than safetensors' own error
        raise UserError(f"{path}: not a readable safetensors file ({error})") from error


def read_torchvision(
    path: Path, *, sha256: str, safe: bool, shapes: Mapping[str, tuple[int, int]] = LAYERS
) -> Source:
    """Read a state dict with torchvision's names (features.0.weight, ..), without the classifier.

    Args:
      path: the file.
      sha256: its hash.
      safe: whether the file is a safetensors file and not one of PyTorch's.
      shapes: input and output channels of each layer.

    Raises:
      UserError: the file is damaged, or is neither a VGG-16 nor a VGG-19.
    """
    found = _read_safetensors(path) if safe else read_tensors(path, NAMES)
    deeper = LAST_19 in found
    if deeper and shapes is LAYERS:
        shapes = layers_of(BLOCKS_19)
    layers = {
        layer: (found.get(f"{module}.weight"), found.get(f"{module}.bias"))
        for module, layer in (NUMBERED_19 if deeper else NUMBERED).items()
    }
    return Source(
        architecture="vgg19" if deeper else "vgg16",
        family="torchvision",
        path=path,
        sha256=sha256,
        layers=check_layers(layers, CONVENTION, path=path, shapes=shapes),
        convention=CONVENTION,
        preprocessing=TORCHVISION,
    )
