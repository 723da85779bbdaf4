"""Files and folders are written whole or not at all, even if the process is killed.

Every result that jaxsfm writes goes through this module. Locks keep two processes from writing the
same files, and digests say what is in them.
"""

import contextlib
import errno
import hashlib
import os
import shutil
import sqlite3
import sys
import tempfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np
import safetensors.numpy
from filelock import FileLock, Timeout
from numpy.typing import ArrayLike

from jaxsfm.errors import UserError, writing
from jaxsfm.io.entries import PARTIAL, remove

Json: TypeAlias = Mapping[str, "Json"] | Sequence["Json"] | str | int | float | bool | None
"""What `json.dumps` writes. What `json.loads` returns is a dict, a list or one of the others."""
CHECKSUM = "crc32"
"""The name of the array that holds the checksum of the others."""
_CANNOT_TRY = (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.ENODEV)
"""A file system that gives no space in advance. The C library of most systems writes instead."""
SPARE_BYTES = 4_000_000
"""Disk space that callers of `check_disk_space` add for what they do not count: the indices of
tables, poses and the report page."""


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing; it takes the place of `path` when the block ends.

    Until then its bytes are in a new file of another name. If `path` is a link, it is replaced, and
    what it leads to stays as it is. Data that the system has not written to the
    disk yet may be lost if power fails; `write_atomic` waits for them. Raises UserError if the file
    cannot be written.
    """
    # The process id keeps two processes from writing the same partial file.
    partial = path.with_name(f"{path.name}.{os.getpid()}{PARTIAL}")
    with writing(path):
        try:
            partial.unlink(missing_ok=True)
            with partial.open("xb") as file:
                yield file
            os.replace(partial, path)
        except OSError:
            with contextlib.suppress(OSError):
                partial.unlink()
            raise


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file so that even after a power failure it is whole or absent."""
    with atomic_file(path) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def save_arrays(path: Path, arrays: Mapping[str, ArrayLike]) -> None:
    """Write arrays into a .safetensors file, with a checksum.

    This does not wait for the disk, so a power failure may tear the file; `load_arrays` treats a
    torn file as absent. Reading the matches of a pair takes 0.05 ms, where an .npz file took 0.8:
    a run reads them four times, and an accelerator matches a pair in 4 ms. Raises UserError if the
    file cannot be written.
    """
    with writing(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
    solid = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    solid[CHECKSUM] = np.asarray([_checksum(solid)], np.uint32)
    with atomic_file(path) as file:
        file.write(safetensors.numpy.save(solid))


def load_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays that `save_arrays` wrote, or None if the file is missing or damaged.

    Nothing in such a file can run code, and no more memory is allocated than the file is long.
    """
    try:
        found = safetensors.numpy.load(path.read_bytes())
        right = found.pop(CHECKSUM).tolist() == [_checksum(found)]
    except Exception:  # damage raises nearly anything: KeyError, ValueError, SafetensorError, ...
        return None
    return found if right else None


def _checksum(arrays: Mapping[str, np.ndarray]) -> int:
    """The CRC-32 of the arrays' names, dtypes, shapes and bytes."""
    found = 0
    for name in sorted(arrays):
        array = arrays[name]
        found = zlib.crc32(f"{name} {array.dtype} {array.shape}".encode(), found)
        found = zlib.crc32(array.reshape(-1).view(np.uint8).data, found)
    return found


def check_disk_space(folder: Path, needed: int) -> None:
    """Raise UserError if less than `needed` bytes are free on the disk of an existing folder.

    COLMAP does not survive a full disk: it ends the process when its database cannot grow, and it
    writes models that are cut off. On Linux, the bytes are given to a file without a name, because
    a quota or a limit on the size of files may leave less than is free on the disk.
    """
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise UserError(
            f"{folder}: cannot be written (about {needed / 1e6:.0f} MB are needed, "
            f"{free / 1e6:.0f} MB are left on the disk)"
        )
    if sys.platform == "linux":
        with writing(folder), tempfile.TemporaryFile(dir=folder) as tried:
            try:
                os.posix_fallocate(tried.fileno(), 0, needed)
            except OSError as error:
                if error.errno not in _CANNOT_TRY:
                    raise


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Make an empty folder; it takes the place of `path` when the block ends.

    The old folder is removed before the new one is renamed, so a process that is killed between
    the two leaves neither. If the block fails, nothing is left of the new folder. If `path` is a
    link, it is replaced, and what it leads to stays as it is.
    """
    partial = path.with_name(path.name + PARTIAL)
    remove(partial)
    partial.mkdir(parents=True)
    try:
        yield partial
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    remove(path)
    partial.rename(path)


@contextlib.contextmanager
def only_process(lock: Path, in_use: str) -> Iterator[None]:
    """Hold a lock while the block runs.

    The operating system holds it for its process, so it vanishes with the process, even if that is
    killed.

    Args:
      lock: the file that is locked; it is made if it is missing. Its folder must exist.
      in_use: what to tell the user if another process holds the lock.

    Raises:
      UserError: another process holds the lock. This is not waited for.
      OSError: the file cannot be written, or its file system has no locks.
    """
    # On a file system without locks, filelock would write a file that a killed process leaves.
    held = FileLock(lock, fallback_to_soft=False)
    try:
        held.acquire(blocking=False)
    except Timeout as error:
        raise UserError(in_use) from error
    try:
        yield
    finally:
        held.release()


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file's content, hexadecimal; the file is read in parts."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def rows_sha256(database: Path) -> str:
    """The SHA-256 of every row of every table of an SQLite database, hexadecimal.

    The file's own hash is of no use: COLMAP writes into a database's header whenever it opens it.

    Raises:
      sqlite3.DatabaseError: the database is damaged.
    """
    digest = hashlib.sha256()
    uri = f"{database.absolute().as_uri()}?mode=ro&immutable=1"
    with contextlib.closing(sqlite3.connect(uri, uri=True)) as db:
        query = "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
        for (table,) in db.execute(query).fetchall():
            for row in db.execute(f'SELECT * FROM "{table}" ORDER BY rowid'):
                for value in (table, *row):
                    data = value if isinstance(value, bytes) else repr(value).encode()
                    digest.update(b"%d:" % len(data) + data)
    return digest.hexdigest()
