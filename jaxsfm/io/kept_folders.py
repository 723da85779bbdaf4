"""Folders that are computed once and kept, under a key made of all that they depend on."""

import sqlite3
from collections.abc import Callable
from pathlib import Path

from jaxsfm.io.atomic import atomic_folder
from jaxsfm.io.hashes import rows_sha256, sha256_of
from jaxsfm.io.store import digest

_KEY = "key"


def is_kept(folder: Path, key: str) -> bool:
    """Whether the files of a folder are whole and were made with this key."""
    try:
        found = (folder / _KEY).read_text(encoding="ascii")
        return found == f"{key} {_content(folder)}"
    except (OSError, ValueError):
        return False


def keep(folder: Path, key: str, compute: Callable[[Path], None]) -> None:
    """Compute the files of a folder; they appear together, and replace those that were there.

    Args:
      compute: writes the files into the given folder.
    """
    with atomic_folder(folder) as fresh:
        compute(fresh)
        (fresh / _KEY).write_text(f"{key} {_content(fresh)}", encoding="ascii")


def forget(folder: Path) -> None:
    """Make the next `is_kept` say no."""
    (folder / _KEY).unlink(missing_ok=True)


def _content(folder: Path) -> str:
    """A digest of the files; it shows files that a power failure tore."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p != folder / _KEY)
    return digest([[p.relative_to(folder).as_posix(), _hash(p)] for p in files])


def _hash(file: Path) -> str:
    if file.suffix != ".db":
        return sha256_of(file)
    try:
        return rows_sha256(file)
    except sqlite3.DatabaseError as error:
        return f"damaged: {error}"
