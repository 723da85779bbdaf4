"""Keypoints and matches as other tools' files hold them, in this package's pixels, checked."""

from typing import NamedTuple

import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, describe, make_pair

MAX_KEYPOINTS = 10_000_000
"""Of one image; a file that claims more is damaged."""


class CameraRow(NamedTuple):
    """A camera as COLMAP's database has it."""

    model: int
    """COLMAP's number of the camera model."""
    params: tuple[float, ...]
    """COLMAP's pixels; the focal length in x comes first."""
    known: bool
    """The focal length was known before mapping."""


class Tables(NamedTuple):
    """What was matched, whoever matched it."""

    sizes: dict[str, tuple[int, int]]
    """Image name -> (width, height), of the images whose size is told."""
    cameras: dict[str, CameraRow]
    """By image name; empty where the file has none."""
    keypoints: dict[str, np.ndarray]
    """float32 (n, 2): (x, y), original pixels, centre of the top-left pixel (0, 0)."""
    matches: dict[Pair, np.ndarray]
    """int32 (m, 2): indices of keypoints, before verification."""
    inliers: dict[Pair, np.ndarray]
    """The same, two-view inliers; empty where nothing was verified."""


def checked_keypoints(values: np.ndarray, where: str) -> np.ndarray:
    """float32 (n, 2) of finite (x, y).

    Args:
      where: how messages begin.

    Raises:
      UserError: not numbers, fewer than two columns, not finite.
    """
    if values.ndim != 2 or values.shape[1] < 2 or values.dtype.kind not in "fiu":
        raise UserError(f"{where}: keypoints must be numbers, n x 2; got {values.shape}")
    with np.errstate(over="ignore"):
        xy = values[:, :2].astype(np.float32)
    if not np.isfinite(xy).all():
        raise UserError(f"{where}: keypoints must be finite")
    return xy


def checked_matches(
    rows: np.ndarray, names: tuple[str, str], keypoints: dict[str, np.ndarray], where: str
) -> tuple[Pair, np.ndarray]:
    """The pair in canonical order, and its matches (m, 2) with the columns in that order.

    Args:
      rows: integers (m, 2), columns in the order of `names`.

    Raises:
      UserError: an image matched with itself, without keypoints, or an index out of range.
    """
    if names[0] == names[1]:
        raise UserError(f"{where}: {shown_name(names[0])} is matched with itself")
    for side, name in enumerate(names):
        count = len(keypoints.get(name, ()))
        if len(rows) and not (0 <= rows[:, side].min() and rows[:, side].max() < count):
            raise UserError(
                f"{where}: a match of {describe(names)} names keypoint "
                f"{max(rows[:, side].max(), rows[:, side].min(), key=abs)} of "
                f"{shown_name(name)}, which has {count}"
            )
    pair = make_pair(*names)
    return pair, (rows if pair == names else rows[:, ::-1]).astype(np.int32)


def one_to_one(rows: np.ndarray) -> np.ndarray:
    """The matches (m, 2) that are the first of both their keypoints: tracks want them so."""
    first0, first1 = (np.unique(column, return_index=True)[1] for column in rows.T)
    return rows[np.intersect1d(first0, first1)]
