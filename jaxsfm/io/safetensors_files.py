"""Safetensors files of ours: named arrays, and in one entry of the metadata what they are.

Nothing in such a file can run code. Shapes and dtypes are known before an array is read, so that a
file of something else costs nothing.
"""

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.hashes import sha256_of


def save_tensors(
    path: Path, tensors: Mapping[str, np.ndarray], *, marker: str, about: Mapping[str, Any]
) -> None:
    """Write arrays as float32; the same ones give the same bytes.

    Args:
      marker: the format's name and version, under which `about` (plain JSON) is kept.

    Raises:
      UserError: the file cannot be written.
    """
    arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in tensors.items()}
    # One entry: safetensors writes several in changing order.
    metadata = {marker: json.dumps(about, sort_keys=True)}
    write_atomic(path, safetensors.numpy.save(arrays, metadata=metadata))


class TensorFile:
    """An open file; `open_tensors`."""

    def __init__(self, path: Path, file: Any, about: dict[str, Any], sha256: str) -> None:
        self.path, self.about, self.sha256 = path, about, sha256
        self._file = file
        self.shapes: dict[str, tuple[int, ...]] = {
            name: tuple(file.get_slice(name).get_shape()) for name in file.keys()
        }

    def check(self, name: str, shape: tuple[int, ...]) -> None:
        """Raises UserError unless `name` is a float32 array of this shape."""
        if name not in self.shapes:
            raise UserError(f"{self.path}: {name} is missing")
        dtype = self._file.get_slice(name).get_dtype()
        if self.shapes[name] != shape or dtype != "F32":
            raise UserError(
                f"{self.path}: {name} must be float32 {shape}; got {dtype} {self.shapes[name]}"
            )

    def read(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """A float32 array of this shape whose values are finite.

        Raises:
          UserError: it is none.
        """
        self.check(name, shape)
        array = self._file.get_tensor(name)
        if not np.isfinite(array).all():
            raise UserError(f"{self.path}: {name} has values that are not finite")
        return array


def has_marker(path: Path, marker: str) -> bool:
    """Whether a file is a safetensors file of this format; False for anything unreadable."""
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return marker in (file.metadata() or {})
    except Exception:  # a damaged file can raise more than safetensors' own error
        return False


@contextlib.contextmanager
def open_tensors(path: Path, *, marker: str, what: str, made_by: str) -> Iterator[TensorFile]:
    """Open a file that `save_tensors` wrote.

    Args:
      what: the file in words, for the error.
      made_by: the command that makes such files.

    Raises:
      UserError: no such file, or of another format.
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
