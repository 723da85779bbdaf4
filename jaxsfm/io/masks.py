"""Which pixels of a photo are used: all but those of its mask, and but blank borders.

A mask has COLMAP's convention: it is an image of the photo's size whose black pixels are ignored,
and the mask of the photo `sub/a.jpg` is the file `sub/a.jpg.png` in the folder of the masks. One
file may be the mask of all photos of its size.
"""

import dataclasses
import hashlib
from pathlib import Path

import cv2
import numpy as np

from jaxsfm.errors import UserError

BLANK = 1
"""The largest value of a pixel in a blank border: rectified photos are black where they have no
content."""
WIDTH = 5
"""A blank border is at least so many pixels wide at every place."""
LEAST_BLANK = 0.02
"""A blank border covers at least this share of the photo. A frame of a few pixels is no matter."""


@dataclasses.dataclass(frozen=True)
class MaskFile:
    """The file of a mask that has been checked."""

    path: Path
    sha256: str
    """The SHA-256 of the file's bytes, hexadecimal."""


def mask_path(masks: Path, name: str) -> Path:
    """Where the mask of a photo lies.

    Args:
      masks: a folder with the mask of each photo, or the file of one mask for all photos.
    """
    return masks if masks.is_file() else masks / f"{name}.png"


def open_mask(path: Path, size: tuple[int, int]) -> MaskFile:
    """Check a mask for a photo of (width, height).

    Raises:
      UserError: the file is no image of this size, or all of it is black.
    """
    used, sha256 = _decoded(path)
    if used is None:
        raise UserError(f"{path}: not a readable mask")
    if used.shape[::-1] != size:
        raise UserError(
            f"{path}: the mask has {used.shape[1]} x {used.shape[0]} pixels and its photo "
            f"{size[0]} x {size[1]}"
        )
    if not used.any():
        raise UserError(f"{path}: the mask is black, so nothing of its photo would be used")
    return MaskFile(path, sha256)


def _decoded(path: Path) -> tuple[np.ndarray | None, str]:
    """The used pixels bool (h, w) of a mask's file, None if it is no image; and its SHA-256."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    gray = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    return None if gray is None else gray > 0, hashlib.sha256(data).hexdigest()


def mask_size(path: Path) -> tuple[int, int] | None:
    """(width, height) of a mask; None if the file is no image. UserError if it cannot be read."""
    used, _ = _decoded(path)
    return None if used is None else (used.shape[1], used.shape[0])


def read_mask(mask: MaskFile) -> np.ndarray:
    """The used pixels bool (h, w); UserError if the file is gone or has changed."""
    used, sha256 = _decoded(mask.path)
    if used is None or sha256 != mask.sha256:
        raise UserError(f"{mask.path}: the mask has changed since it was first read")
    return used


def without_blank_border(rgb: np.ndarray) -> np.ndarray | None:
    """The used pixels bool (h, w) of a photo uint8 (h, w, 3); None if all are.

    Blank pixels that are connected to the border are not used. Dark ones inside the photo are: a
    night has them, too.
    """
    edges = (rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1])
    if not any((edge.max(-1) <= BLANK).any() for edge in edges):
        return None  # most photos, in no time
    blank = cv2.inRange(rgb, (0, 0, 0), (BLANK, BLANK, BLANK))
    # Dark pixels of a night touch each other by chance. What is narrower than the kernel goes.
    blank = cv2.morphologyEx(blank, cv2.MORPH_OPEN, np.ones((WIDTH, WIDTH), np.uint8))
    (height, width), reached = blank.shape, 1
    ends = [(x, y) for y in (0, height - 1) for x in np.flatnonzero(blank[y])]
    ends += [(x, y) for x in (0, width - 1) for y in np.flatnonzero(blank[:, x])]
    for x, y in ends:
        if blank[y, x] != reached:  # in place: labels of all parts would take four times as much
            cv2.floodFill(blank, None, (int(x), int(y)), (reached,))
    border = blank == reached
    return ~border if border.mean() >= LEAST_BLANK else None


def used_cells(used: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Which keypoints (m, 2) lie on used pixels bool (h, w) of the same image: bool (m,)."""
    height, width = used.shape
    x, y = np.rint(keypoints).astype(int).T
    return used[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
