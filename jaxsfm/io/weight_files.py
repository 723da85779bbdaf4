"""Files of parameters in the safetensors format, and converted weights, which are such files.

Weights and relocalizers are kept as named arrays, with one entry of metadata that says what they
are. Nothing in such a file can run code. Shapes and dtypes are known before an array is read, so a
file of something else is refused without reading it.

The package `weights_conversion` writes converted weights: a VGG-16 or VGG-19 of any family in one
format. Channels are in the order RGB, whatever the source had, and kernels are HWIO. The metadata
says how an image must be preprocessed and where the weights come from.
"""

import contextlib
import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors
import safetensors.numpy

from jaxsfm.core.vgg import BLOCKS_19, LAYERS, Preprocessing, layers_of
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json, sha256_of, write_atomic

Parameters = dict[str, dict[str, dict[str, np.ndarray]]]
"""The parameters of a network as flax has them: {'params': {layer: {part: float32 array}}}."""
FORMAT = "jaxsfm weights 1"
"""The format's marker. A file has arrays LAYER.kernel and LAYER.bias; NetVLAD's also `EXTRAS`."""
ARCHITECTURES = {"vgg16": LAYERS, "vgg19": layers_of(BLOCKS_19)}
"""Backbone -> the input and output channels of its layers."""
FAMILIES = ("torchvision", "keras", "caffe", "netvlad")
EXTRAS = {
    "netvlad.assignment": (512, 64),
    "netvlad.centres": (512, 64),
    "netvlad.whitening": (512 * 64, 4096),
    "netvlad.whitening_bias": (4096,),
}
"""The arrays of NetVLAD's head and their shapes, used by retrieval. weights_conversion/README.md
has the equations."""

Shapes = Mapping[str, tuple[int, int]]
"""Layer name -> (input channels, output channels)."""


def save_tensors(
    path: Path, tensors: Mapping[str, np.ndarray], *, marker: str, about: Mapping[str, Json]
) -> None:
    """Write arrays as float32. The same arrays always give the same bytes.

    Args:
      marker: the name and version of the format; `about` is kept under it.
      about: what the arrays are and where they come from.

    Raises:
      UserError: the file cannot be written.
    """
    arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in tensors.items()}
    # There is only one entry, because safetensors writes several entries in changing order.
    metadata = {marker: json.dumps(about, sort_keys=True)}
    write_atomic(path, safetensors.numpy.save(arrays, metadata=metadata))


class TensorFile:
    """An open safetensors file; `open_tensors` makes one."""

    def __init__(
        self, path: Path, file: safetensors.safe_open, about: dict[str, Json], sha256: str
    ) -> None:
        self.path, self.about, self.sha256 = path, about, sha256
        self._file = file
        self.shapes: dict[str, tuple[int, ...]] = {
            name: tuple(file.get_slice(name).get_shape()) for name in file.keys()
        }

    def check(self, name: str, shape: tuple[int, ...]) -> None:
        """Raise UserError unless `name` is a float32 array of this shape."""
        if name not in self.shapes:
            raise UserError(f"{self.path}: {name} is missing")
        dtype = self._file.get_slice(name).get_dtype()
        if self.shapes[name] != shape or dtype != "F32":
            raise UserError(
                f"{self.path}: {name} must be float32 {shape}; got {dtype} {self.shapes[name]}"
            )

    def read(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """A float32 array of this shape and of finite values. Raises UserError if it is none."""
        self.check(name, shape)
        array = self._file.get_tensor(name)
        if not np.isfinite(array).all():
            raise UserError(f"{self.path}: {name} has values that are not finite")
        return array


@contextlib.contextmanager
def open_tensors(path: Path, *, marker: str, what: str, made_by: str) -> Iterator[TensorFile]:
    """Open a file that `save_tensors` wrote.

    Args:
      what: what the file is, in words, for messages.
      made_by: the command that makes such files, for messages.

    Raises:
      UserError: there is no such file, or it has another format.
    """
    try:
        digest = sha256_of(path)
    except OSError as error:
        raise UserError(f"{path}: cannot read the {what} ({error.strerror})") from error
    try:
        file = safetensors.safe_open(path, framework="numpy")
        metadata = file.metadata() or {}
        about = json.loads(metadata.get(marker, "{}"))
        opened = TensorFile(path, file, about, digest)
    except Exception as error:  # a damaged file can raise more than safetensors' own error
        raise UserError(f"{path}: not a readable safetensors file ({error})") from error
    if marker not in metadata or not isinstance(about, dict):
        raise UserError(f"{path}: not a {what}; {made_by!r} makes them")
    with file:
        yield opened


class ConvertedWeights(NamedTuple):
    """The content of a file of converted weights, without the extras."""

    architecture: str
    """One of `ARCHITECTURES`."""
    layers: dict[str, dict[str, np.ndarray]]
    """{layer: {'kernel': float32 HWIO, 'bias': float32 O}}."""
    family: str
    preprocessing: Preprocessing
    about: dict[str, Json]
    """The metadata: where the weights come from."""
    sha256: str


def preprocessing_numbers(p: Preprocessing) -> tuple[float, ...]:
    """The seven numbers of a preprocessing: scale, mean and standard deviation."""
    return (p.scale, *p.mean, *p.std)


def save_weights(
    path: Path,
    layers: Mapping[str, Mapping[str, np.ndarray]],
    *,
    extras: Mapping[str, np.ndarray],
    architecture: str,
    family: str,
    preprocessing: Preprocessing,
    about: Mapping[str, Json],
) -> None:
    """Write converted weights. The same weights always give the same bytes.

    Args:
      layers: {layer: {'kernel': HWIO, input channels RGB, 'bias': O}}.
      extras: those of `EXTRAS` that there are.
      about: where the weights come from; the entry `source` is the name of a file.

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
    """Whether a file says that it holds converted weights; False if it cannot be read."""
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return FORMAT in (file.metadata() or {})
    except Exception:  # a damaged file can raise more than safetensors' own error
        return False


def read_converted(path: Path, *, shapes: Shapes | None = None) -> ConvertedWeights:
    """Read and check converted weights. Of the extras only the shapes are checked.

    Args:
      shapes: the channels of the layers; None takes those of the architecture.

    Raises:
      UserError: there is no such file, or something in it is not as it must be.
    """
    with _open(path) as file:
        architecture = _one_of((*ARCHITECTURES,), file, "architecture")
        family = _one_of(FAMILIES, file, "family")
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
    """Those of `EXTRAS` that a file of converted weights has, float32; UserError if damaged."""
    with _open(path) as file:
        return {name: file.read(name, EXTRAS[name]) for name in EXTRAS if name in file.shapes}


def has_extras(path: Path) -> bool:
    """Whether a file of converted weights has NetVLAD's head; UserError if it cannot be read."""
    with _open(path) as file:
        return all(name in file.shapes for name in EXTRAS)


def _open(path: Path) -> AbstractContextManager[TensorFile]:
    return open_tensors(path, marker=FORMAT, what="weights file", made_by="jaxsfm weights convert")


def _one_of(known: tuple[str, ...], file: TensorFile, name: str) -> str:
    """An entry of the metadata, which must be one of the known words."""
    value = file.about.get(name)
    if not isinstance(value, str) or value not in known:
        raise UserError(f"{file.path}: its {name} must be {' or '.join(known)}; got {value!r}")
    return value


def _preprocessing(file: TensorFile) -> Preprocessing:
    about = file.about.get("preprocessing")
    try:
        if not isinstance(about, dict):
            raise TypeError("'preprocessing' must be an object")
        mean, std = _three(about["mean"]), _three(about["std"])
        found = Preprocessing(_number(about["scale"]), mean, std)
        if not np.isfinite(preprocessing_numbers(found)).all() or min(found.scale, *std) <= 0:
            raise ValueError("finite means, positive deviations and scale are needed")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{file.path}: its preprocessing cannot be used ({error})") from error
    return found


def _three(values: Json) -> tuple[float, float, float]:
    if not isinstance(values, list):
        raise TypeError(f"three numbers are needed; got {values!r}")
    red, green, blue = map(_number, values)
    return red, green, blue


def _number(value: Json) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"a number is needed; got {value!r}")
    return float(value)
