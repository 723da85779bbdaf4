"""Reads files of any family, recognized by their first bytes, and writes them in one format."""

import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from jaxsfm.core.vgg import LAYERS
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import sha256_of
from jaxsfm.io.weight_files import FORMAT, is_converted, save_weights
from jaxsfm.weights_conversion.keras_files import Kernels, read_keras
from jaxsfm.weights_conversion.matlab_files import read_matlab
from jaxsfm.weights_conversion.source import (
    Family,
    Source,
    canonical_layers,
    canonical_preprocessing,
)
from jaxsfm.weights_conversion.torchvision import read_torchvision

CONVERTER = 1
"""The version of the converter. It changes when a conversion gives other numbers than before."""
Kind = Literal["torch", "safetensors", "hdf5", "matlab"]
LEGACY_TORCH = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."
"""The first bytes of the files that PyTorch before 1.6 wrote: a pickled magic number."""


def file_kind(path: Path) -> Kind:
    """Recognize a file by its first bytes.

    Raises:
      UserError: the file is none of the known kinds, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            head = file.read(128)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    if head.startswith((b"PK\x03\x04", LEGACY_TORCH)):
        return "torch"
    if head.startswith(b"\x89HDF\r\n\x1a\n"):
        return "hdf5"
    if head.startswith(b"MATLAB 5.0"):
        return "matlab"
    if head.startswith(b"MATLAB 7.3"):
        raise UserError(
            f"{path}: a MATLAB file of version 7.3; save it in MATLAB with '-v7', which can be read"
        )
    if head[8:9] == b"{":
        return "safetensors"
    raise UserError(
        f"{path}: no file of VGG-16 weights that is known (PyTorch, safetensors, Keras' .h5, "
        "MatConvNet's .mat)"
    )


def read_source(
    path: Path,
    *,
    family: Family | Literal["auto"] = "auto",
    kernels: Kernels = "auto",
    shapes: Mapping[str, tuple[int, int]] = LAYERS,
) -> Source:
    """Read the weights of a file, in its own convention.

    Args:
      path: the file.
      family: the family that it must belong to; auto accepts any.
      kernels: whether the kernels of a Keras file are turned
        (`weights_conversion.keras_files.read_keras`).
      shapes: input and output channels of each layer.

    Raises:
      UserError: the file cannot be read, is damaged, is not a VGG-16, or is of another family.
    """
    kind = file_kind(path)
    if is_converted(path):
        raise UserError(f"{path}: the file is converted already")
    sha256 = sha256_of(path)
    if kind == "hdf5":
        source = read_keras(path, sha256=sha256, kernels=kernels, shapes=shapes)
    elif kind == "matlab":
        source = read_matlab(path, sha256=sha256, shapes=shapes)
    else:
        safe = kind == "safetensors"
        source = read_torchvision(path, sha256=sha256, safe=safe, shapes=shapes)
    if kernels != "auto" and kind != "hdf5":
        raise UserError(f"--kernels {kernels}: only Keras' files need it; {path} is none of them")
    if family not in ("auto", source.family):
        raise UserError(f"--family {family}: {path} is of the family {source.family}")
    return source


def write_converted(source: Source, out: Path) -> None:
    """Write a source in jaxsfm's format (`jaxsfm.io.weight_files`).

    Raises:
      UserError: the file cannot be written, or it is the source itself.
    """
    if out.exists() and out.samefile(source.path):
        raise UserError(f"{out}: this is the file to convert; name another file for the result")
    save_weights(
        out,
        canonical_layers(source),
        extras=source.extras,
        architecture=source.architecture,
        family=source.family,
        preprocessing=canonical_preprocessing(source),
        about={
            "source": source.path.name,
            "source_sha256": source.sha256,
            "source_convention": source.convention._asdict(),
            "converter": CONVERTER,
            "jaxsfm": importlib.metadata.version("jaxsfm"),
            "format": FORMAT,
        },
    )
