"""Keypoints and matches from files of other tools, checked, in this package's pixels."""

from typing import NamedTuple

import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, describe, make_pair

MAX_KEYPOINTS = 10_000_000
"""Keypoints of one image. A file that claims more is damaged."""


class Tables(NamedTuple):
    """Keypoints and matches of another tool's files."""

    sizes: dict[str, tuple[int, int]]
    """Image name -> (width, height), of the images whose size the file holds."""
    focal_px: dict[str, float]
    """By image name, the focal lengths in x that were known before mapping, original pixels."""
    keypoints: dict[str, np.ndarray]
    """float32 (n, 2): (x, y), original pixels, centre of the top-left pixel (0, 0)."""
    matches: dict[Pair, np.ndarray]
    """int32 (m, 2): indices of keypoints, before verification."""
    inliers: dict[Pair, np.ndarray]
    """The same for two-view inliers; empty if nothing was verified."""


def checked_keypoints(values: np.ndarray, where: str) -> np.ndarray:
    """Check keypoints, and return their (x, y) as float32 (n, 2).

    Raises:
      UserError: they are no numbers, have fewer than two columns, or are not finite. The message
        begins with `where`.
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
    """Check the matches of a pair.

    Args:
      rows: integers (m, 2), columns in the order of `names`.

    Returns:
      the pair, with its names in order; int32 (m, 2), with its columns in that order.

    Raises:
      UserError: an image is matched with itself, or an index is out of range.
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
