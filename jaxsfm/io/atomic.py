"""Files and folders that appear whole or not at all, whenever the process is killed."""

import contextlib
import json
import math
import os
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jaxsfm.errors import UserError

PARTIAL = ".partial"
"""Ends the name of what is being written."""
SPARE_BYTES = 4_000_000
"""Left on the disk beside what is counted: tables' indices, poses, the page."""


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write that appears whole or not at all.

    Raises:
      UserError: it cannot be written (permission, disk full).
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}{PARTIAL}")  # nobody else's
    try:
        with partial.open("wb") as file:
            yield file
        os.replace(partial, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise UserError(f"{path}: cannot be written ({error.strerror})") from error


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file that is either whole or absent, after a failure of power too."""
    with atomic_file(path) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def save_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays into an .npz whose zip carries checksums: where power failed the file may be
    torn, and is then read as absent."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{path.parent}: cannot be written ({error.strerror})") from error
    with atomic_file(path) as file:
        np.savez(file, **arrays)


def load_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """What `save_arrays` wrote; None if there is none or it is damaged. Never unpickles, and
    allocates no more than the file is long."""
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                _check_member(archive, info)
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception:  # damage raises nearly anything: struct.error, TokenError, MemoryError, ...
        return None


def _check_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> None:
    """ValueError unless an array takes the room in the file that its header says."""
    with archive.open(info) as file:
        read = np.lib.format
        version = read.read_magic(file)  # pyright: ignore[reportArgumentType]
        head = read.read_array_header_1_0 if version == (1, 0) else read.read_array_header_2_0
        shape, _, dtype = head(file)  # pyright: ignore[reportArgumentType]
        stored = info.compress_type == zipfile.ZIP_STORED and min(shape, default=0) >= 0
        if not stored or file.tell() + math.prod(shape) * dtype.itemsize != info.file_size:
            raise ValueError(f"{info.filename}: {info.file_size} bytes for {shape} {dtype}")


def read_json(path: Path) -> Any:
    """The content of a file, None where it cannot be read as JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def check_disk_space(folder: Path, needed: int) -> None:
    """Refuse what would not fit on the disk, before code that does not survive that begins.

    COLMAP ends the process where a database cannot grow, and writes models that are cut off.

    Args:
      needed: bytes.

    Raises:
      UserError: what is needed and what there is.
    """
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise UserError(
            f"{folder}: cannot be written (about {needed / 1e6:.0f} MB are needed, "
            f"{free / 1e6:.0f} MB are left on the disk)"
        )


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """A folder to fill that takes the place of `path` when it is complete.

    Between the old one's end and the new one's beginning there may be none.
    """
    partial = path.with_name(path.name + PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    yield partial
    shutil.rmtree(path, ignore_errors=True)
    partial.rename(path)
