"""Reads and checks a benchmark's inputs; every error names the file."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile, inspect_image

T = TypeVar("T")


def choose_sets(found: dict[str, T], names: Sequence[str] | None, root: Path | str) -> list[T]:
    """The sets called `names`, in that order; all sets, sorted by name, if `names` is None.

    Args:
      found: the path of every set in `root`, or what else stands for it, by name.

    Raises:
      UserError: `names` is empty, or one of them is not in `found`.
    """
    if names is None:
        return [found[name] for name in sorted(found)]
    if not names:
        raise UserError("--sets: none given")
    if unknown := [name for name in names if name not in found]:
        raise UserError(f"--sets: no set {unknown[0]!r} in {root} (there: {sorted(found)})")
    return [found[name] for name in names]


def check_root(root: Path) -> None:
    """Raise UserError unless `root` is a folder."""
    if not root.is_dir():
        raise UserError(f"--root {root}: no such folder")


def read_rows(path: Path, columns: int, what: str) -> np.ndarray:
    """Read a text file of finite numbers, float64 (n, columns).

    Args:
      what: a description of the rows for the error message.

    Raises:
      UserError: the file is empty or holds anything else.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = np.asarray([[float(v) for v in line.split()] for line in lines if line.strip()])
    except (OSError, ValueError) as error:
        raise UserError(f"--root: {path} cannot be read; expected {what}") from error
    if rows.ndim != 2 or rows.shape[1] != columns or not np.isfinite(rows).all():
        raise UserError(f"--root: {path} must hold {what}")
    return rows


def usable_image(path: Path, *, name: str | None = None) -> ImageFile:
    """The image file at `path`, called `name` (default: the file's name).

    Raises:
      UserError: the image cannot be used. The sentence names the whole path.
    """
    return dataclasses.replace(inspect_image(path, name=str(path)), name=name or path.name)
