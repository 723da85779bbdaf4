"""torchvision's vgg16: RGB in [0, 1], ImageNet statistics, OIHW kernels."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors

from jaxsfm.core.vgg import LAYERS
from jaxsfm.errors import UserError
from jaxsfm.host.weights import TORCHVISION
from weights_conversion.source import NUMBERED, Convention, Source, check_layers
from weights_conversion.torch_files import read_tensors

CONVENTION = Convention(layout="OIHW", bgr=False, convolution=False)
NAMES = [f"{module}.{part}" for module in NUMBERED for part in ("weight", "bias")]


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name) for name in set(NAMES) & set(file.keys())}
    except Exception as error:  # a damaged file can raise more than safetensors' own error
        raise UserError(f"{path}: not a readable safetensors file ({error})") from error


def read_torchvision(
    path: Path, *, sha256: str, safe: bool, shapes: Mapping[str, tuple[int, int]] = LAYERS
) -> Source:
    """A state dict of torchvision's names (features.0.weight, ..); the classifier is left out.

    Args:
      safe: a safetensors file, not one of PyTorch's.

    Raises:
      UserError: it is damaged, or not a VGG-16.
    """
    found = _read_safetensors(path) if safe else read_tensors(path, NAMES)
    layers = {
        layer: (found.get(f"{module}.weight"), found.get(f"{module}.bias"))
        for module, layer in NUMBERED.items()
    }
    return Source(
        family="torchvision",
        path=path,
        sha256=sha256,
        layers=check_layers(layers, CONVENTION, path=path, shapes=shapes),
        convention=CONVENTION,
        preprocessing=TORCHVISION,
    )
