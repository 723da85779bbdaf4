"""Which views of a model are turned by quarter turns against the others.

Most photos are taken upright, so the directions that are up in most photos agree. A photo that is
stored sideways, without a note in EXIF, shows this direction to its left, to its right or
downwards.
"""

import numpy as np

from jaxsfm.colmap.poses import Poses
from jaxsfm.io import orientation

AGREE_DEG = 30.0
"""Two photos agree on what is up within this angle. People hold cameras level to a few degrees;
half of a quarter turn would be 45."""
LEAST_SHARE = 0.5
"""The share of the photos that agree on what is up, at least. Without it nothing is turned."""
LEAST_VISIBLE = 0.5
"""The sine of the angle between the view's axis and the direction that is up, at least. A photo
that looks straight down has no upright."""


def quarter_turns(poses: Poses, orientations: dict[str, int]) -> dict[str, int]:
    """How many quarter turns clockwise make turned photos upright, by name: 1, 2 or 3.

    Args:
      poses: of the stored photos.
      orientations: how photos are already turned, by name; others are stored upright.
    """
    names = sorted(poses)
    if not names:
        return {}
    codes = [orientations.get(name, orientation.UPRIGHT) for name in names]
    rotations = [
        _upright_axes(code) @ poses[name].rotation for name, code in zip(names, codes, strict=True)
    ]
    ups = -np.stack([rotation[1] for rotation in rotations])  # y points down in pictures
    agree = ups @ ups.T > np.cos(np.radians(AGREE_DEG))
    most = int(agree.sum(1).argmax())
    if agree[most].mean() <= LEAST_SHARE:
        return {}
    up = ups[agree[most]].mean(0)
    up /= np.linalg.norm(up)
    found = {}
    for name, rotation in zip(names, rotations, strict=True):
        x, y, _ = rotation @ up
        quarters = np.degrees(np.arctan2(x, -y)) / 90  # clockwise from the top of the picture
        near = abs(quarters - round(quarters)) * 90 < AGREE_DEG
        if np.hypot(x, y) > LEAST_VISIBLE and near and round(quarters) % 4:
            found[name] = -round(quarters) % 4
    return found


def _upright_axes(code: int) -> np.ndarray:
    """The rotation (3, 3) from the axes of a stored photo to those of the upright one.

    A mirrored photo has no such rotation; its axes are taken as they are stored.
    """
    return orientation.stored_axes(code).T if code in orientation.QUARTERS else np.eye(3)
