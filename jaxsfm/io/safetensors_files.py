"""Safetensors files of named arrays, with one entry of metadata that says what they are.

Weights and relocalizers are kept in such files. Nothing in them can run code. Shapes and dtypes are
known before an array is read, so a file of something else is refused without reading it.
"""

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json, sha256_of, write_atomic

Parameters = dict[str, dict[str, dict[str, np.ndarray]]]
"""The parameters of a network as flax has them: {'params': {layer: {part: float32 array}}}."""


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


def has_marker(path: Path, marker: str) -> bool:
    """Whether a file is a safetensors file of this format; False if it cannot be read."""
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return marker in (file.metadata() or {})
    except Exception:  # a damaged file can raise more than safetensors' own error
        return False


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
