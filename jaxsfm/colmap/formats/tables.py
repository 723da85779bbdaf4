"""What the formats share: keypoints and matches from files of other tools, checked, in this
package's pixels, and checks of the names of images."""

from collections.abc import Iterable
from pathlib import PurePath
from typing import NamedTuple

import numpy as np
import pycolmap

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


def check_no_blanks(names: Iterable[str], to: str) -> None:
    """Raise UserError for names that a format would cut in two."""
    for name in names:
        if len(name.split()) != 1 or name != name.strip():
            raise UserError(
                f"--to {to}: {shown_name(name)!r} has a blank in it, where {to} ends a name"
            )


def leads_out(name: str, path_type: type[PurePath] = PurePath) -> bool:
    """Whether a name, joined to a folder, gives a path that is not below the folder.

    Args:
      path_type: the kind of paths of the system. On Windows, drives (`C:a.jpg`) and the separator
        `\\` lead out as well.
    """
    path = path_type(name)
    return bool(path.anchor) or ".." in path.parts


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """The images with a pose, by name; UserError if a name leads out of the photos' folder."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    for image in images:
        if leads_out(image.name):
            raise UserError(f"{shown_name(image.name)}: an image outside the photos' folder")
    return sorted(images, key=lambda image: image.name)
