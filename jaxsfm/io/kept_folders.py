"""Folders that are computed once and kept, under a key made of all that they depend on."""

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jaxsfm.io.atomic import Json, atomic_folder
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


class Steps(NamedTuple):
    """Kept parts of work that is not finished: if it is interrupted, it goes on after the last one.

    The parts are read from their files even if they have just been computed, so that work that was
    interrupted ends as it would have.
    """

    folder: Path
    key: str
    """Identifies everything that the whole work depends on."""

    def kept(self, kind: str, about: Json, compute: Callable[[Path], None]) -> Path:
        """The folder with the files of a part, which is computed only if they are not there yet.

        Args:
          kind: of the part; it begins the name of its folder.
          about: what the part depends on besides the key of the whole work.
          compute: writes the files into the given folder.
        """
        key = digest(self.key, about)
        target = self.folder / f"{kind}-{key[:16]}"
        if not is_kept(target, key):
            keep(target, key, compute)
        return target


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
