"""Converted weights: a VGG-16 or VGG-19 of any family in one safetensors format.

`weights_conversion` writes them. Channels are RGB whatever the source had, kernels HWIO, and the
metadata says what they expect of an image and where they come from.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsfm.core.vgg import BLOCKS_19, LAYERS, Preprocessing, layers_of
from jaxsfm.errors import UserError
from jaxsfm.io.safetensors_files import TensorFile, has_marker, open_tensors, save_tensors

FORMAT = "jaxsfm weights 1"
"""Of converted weights: arrays LAYER.kernel and LAYER.bias, of NetVLAD also `EXTRAS`."""
ARCHITECTURES = {"vgg16": LAYERS, "vgg19": layers_of(BLOCKS_19)}
"""Backbone -> its layers' input and output channels."""
FAMILIES = ("torchvision", "keras", "caffe", "netvlad")
EXTRAS = {
    "netvlad.assignment": (512, 64),
    "netvlad.centres": (512, 64),
    "netvlad.whitening": (512 * 64, 4096),
    "netvlad.whitening_bias": (4096,),
}
"""NetVLAD's head, kept for retrieval: weights_conversion/README.md has its equations."""

Shapes = Mapping[str, tuple[int, int]]
"""Layer name -> (input channels, output channels)."""


class ConvertedWeights(NamedTuple):
    """What such a file holds, without its extras."""

    architecture: str
    """One of `ARCHITECTURES`."""
    layers: dict[str, dict[str, np.ndarray]]
    """{layer: {'kernel': float32 HWIO, 'bias': float32 O}}."""
    family: str
    preprocessing: Preprocessing
    about: dict[str, Any]
    sha256: str


def flat(p: Preprocessing) -> tuple[float, ...]:
    """Its seven numbers."""
    return (p.scale, *p.mean, *p.std)


def save_weights(
    path: Path,
    layers: Mapping[str, Mapping[str, np.ndarray]],
    *,
    extras: Mapping[str, np.ndarray],
    architecture: str,
    family: str,
    preprocessing: Preprocessing,
    about: Mapping[str, Any],
) -> None:
    """Write converted weights; the same ones give the same bytes.

    Args:
      layers: {layer: {'kernel': HWIO, input channels RGB, 'bias': O}}.
      extras: of `EXTRAS`.
      about: where they come from; its `source` is a file's name.

    Raises:
      UserError: the file cannot be written.
    """
    tensors = {f"{name}.{part}": each[part] for name, each in layers.items() for part in each}
    described = {
        "architecture": architecture,
        "family": family,
        "preprocessing": preprocessing._asdict(),
    }
    save_tensors(path, {**tensors, **extras}, marker=FORMAT, about={**about, **described})


def is_converted(path: Path) -> bool:
    """Whether a file says that it is one."""
    return has_marker(path, FORMAT)


def read_converted(path: Path, *, shapes: Shapes | None = None) -> ConvertedWeights:
    """Read and check converted weights; the extras' shapes are checked, not their values.

    Args:
      shapes: of the layers; None: the architecture's.

    Raises:
      UserError: no such file, or something in it is not as it must be.
    """
    with _open(path) as file:
        for name, known in (("architecture", (*ARCHITECTURES,)), ("family", FAMILIES)):
            if file.about.get(name) not in known:
                raise UserError(
                    f"{path}: its {name} must be {' or '.join(known)}; got {file.about.get(name)!r}"
                )
        architecture, family = file.about["architecture"], file.about["family"]
        shapes = shapes or ARCHITECTURES[architecture]
        own = {f"{name}.{part}" for name in shapes for part in ("kernel", "bias")}
        for name in sorted(file.shapes.keys() - own):
            if name not in EXTRAS:
                raise UserError(f"{path}: {name} does not belong in a weights file")
            file.check(name, EXTRAS[name])
        layers = {
            name: {
                "kernel": file.read(f"{name}.kernel", (3, 3, inputs, outputs)),
                "bias": file.read(f"{name}.bias", (outputs,)),
            }
            for name, (inputs, outputs) in shapes.items()
        }
        preprocessing = _preprocessing(file)
        return ConvertedWeights(
            architecture, layers, family, preprocessing, file.about, file.sha256
        )


def read_extras(path: Path) -> dict[str, np.ndarray]:
    """Those of `EXTRAS` that a converted file has, float32.

    Raises:
      UserError: as `read_converted`.
    """
    with _open(path) as file:
        return {name: file.read(name, EXTRAS[name]) for name in EXTRAS if name in file.shapes}


def has_extras(path: Path) -> bool:
    """Whether a converted file has NetVLAD's head. Raises UserError as `read_converted`."""
    with _open(path) as file:
        return all(name in file.shapes for name in EXTRAS)


def _open(path: Path) -> AbstractContextManager[TensorFile]:
    return open_tensors(path, marker=FORMAT, what="weights file", made_by="jaxsfm weights convert")


def _preprocessing(file: TensorFile) -> Preprocessing:
    try:
        about = file.about["preprocessing"]
        mean, std = _three(about["mean"]), _three(about["std"])
        found = Preprocessing(float(about["scale"]), mean, std)
        if not np.isfinite(flat(found)).all() or min(found.scale, *std) <= 0:
            raise ValueError("finite means, positive deviations and scale are needed")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{file.path}: its preprocessing cannot be used ({error})") from error
    return found


def _three(values: Any) -> tuple[float, float, float]:
    red, green, blue = values
    return float(red), float(green), float(blue)
