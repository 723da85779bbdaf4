"""The sets of Strecha et al. (CVPR 2008): photos of one camera with known poses."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxsfm.bench.inputs import check_root, choose_sets, read_rows
from jaxsfm.colmap.poses import Poses, read_poses
from jaxsfm.errors import UserError


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
    (docs/results.md).

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
