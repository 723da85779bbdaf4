"""Reads and checks a benchmark's inputs: Strecha's sets and frames of a video, both with poses.

Every error names the file. Strecha's sets (CVPR 2008) are photos of one camera.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from jaxsfm.colmap.poses import Poses, read_poses
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile, inspect_image
from jaxsfm.io.pair_selection import natural

T = TypeVar("T")
PHOTOS = (".jpg", ".jpeg", ".png")
"""What the names of frames end with."""


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


class StrechaSet(NamedTuple):
    """A set of photos with ground truth."""

    folder: Path
    camera: str
    """The photos' camera as `MODEL:params`, in COLMAP's pixels."""
    focal: float
    """Its focal length, pixels."""
    truth: Poses


def strecha_intrinsics(folder: Path) -> tuple[str, float]:
    """A set's camera as `MODEL:params`, and its focal length in pixels.

    The sets' K counts pixels from the image's corner, as COLMAP does: K was halved together with
    the images, which is exact only for that convention, and rotations agree better with it
    (docs/decisions/benchmarks.md).

    Raises:
      UserError: images/K.txt is missing or not a camera matrix.
    """
    path = folder / "images" / "K.txt"
    k = read_rows(path, 3, "a camera matrix (3 x 3)")
    if k.shape != (3, 3) or k[0, 0] <= 0 or k[1, 1] <= 0:
        raise UserError(f"--root: {path} is not a camera matrix")
    fx, fy, cx, cy = (float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    return f"PINHOLE:{fx!r},{fy!r},{cx!r},{cy!r}", 0.5 * (fx + fy)


def find_sets(root: Path, names: Sequence[str] | None) -> list[Path]:
    """The folders of the sets in `root` (those with images/K.txt) that are called `names`.

    Args:
      names: None stands for all sets, sorted by name.

    Raises:
      UserError: there is no set, or none with one of the names.
    """
    check_root(root)
    found = {path.parent.parent.name: path.parent.parent for path in root.glob("*/images/K.txt")}
    if not found:
        raise UserError(f"--root {root}: no Strecha sets (SET/images/K.txt) in it")
    return choose_sets(found, names, root)


def read_sets(root: Path, names: Sequence[str] | None) -> list[StrechaSet]:
    """Read the cameras and poses of the sets in `root` that are called `names`; None is all.

    Raises:
      UserError: a set is missing, or its camera or poses cannot be read.
    """
    return [read_set(folder) for folder in find_sets(root, names)]


def read_set(folder: Path) -> StrechaSet:
    """Read the camera and the poses of a set; UserError if they cannot be read."""
    return StrechaSet(folder, *strecha_intrinsics(folder), read_poses(folder, option="--root"))


class Frames(NamedTuple):
    """The frames of a folder that are used."""

    mapped: list[Path]
    localized: list[Path]


def chosen_frames(folder: Path, every: int, localize: int) -> Frames:
    """Each `every`-th frame by name; of these, each `localize`-th is localized (0: none).

    Raises:
      UserError: there are fewer than three frames.
    """
    found = [p for p in folder.iterdir() if p.suffix.lower() in PHOTOS]
    frames = sorted(found, key=lambda path: natural(path.name))[::every]
    if len(frames) < 3:
        raise UserError(f"{folder}: fewer than three frames")
    out = frames[localize // 2 :: localize] if localize else []
    return Frames([path for path in frames if path not in out], out)


def linked(photos: Path, names: Iterable[str], folder: Path) -> Path:
    """A folder with links to some photos of another one, by their paths below it, and no others."""
    wanted = {folder / name: (photos / name).absolute() for name in names}
    for path in list(folder.rglob("*")):
        if path.is_symlink() and wanted.get(path) != path.readlink():
            path.unlink()
    for link, photo in wanted.items():
        link.parent.mkdir(parents=True, exist_ok=True)
        if not link.is_symlink():
            link.symlink_to(photo)
    return folder
