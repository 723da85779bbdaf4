"""The evidence for a pose from matches: keypoints of an image, and the surface under them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.view import View
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.refine import plane_geometry

REACH_PX = 16.0
"""A match lies on the surface of an observation this near, working pixels: two fine cells."""
MATCH_ERROR_PX = 12.0
"""Largest error of a right match, working pixels: COLMAP's limit for resection. The keypoints of a
dark image are about 4 px off, and cells are 8 px wide."""


class Evidence(NamedTuple):
    """Facts that refinement uses besides the model."""

    matches: Mapping[Pair, PairResult]
    """Verified matches by pair, original pixels."""
    seed: int
    """For RANSAC in the resection from matches."""


NO_EVIDENCE = Evidence({}, 0)


def matched_points(
    image: View, structure: Model, normal: np.ndarray, matches: Mapping[Pair, PairResult]
) -> tuple[np.ndarray, np.ndarray]:
    """Matched keypoints of an image, and the surface under the keypoints that they match.

    Args:
      image: its pose plays no part.
      normal: (points, 3), of the structure's points.
      matches: original pixels. Pairs of other images are ignored.

    Returns:
      float64 (n, 2), working pixels of the image; float64 (n, 3), world points.
    """
    xy, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
    number = {view.name: k for k, view in enumerate(structure.views)}
    own = [pair for pair in matches if image.name in pair]
    others = [(number.get(b if a == image.name else a), (a, b)) for a, b in own]
    for k, pair in sorted((k, pair) for k, pair in others if k is not None):
        view, result = structure.views[k], matches[pair]
        sides = (result.keypoints0, result.keypoints1)
        mine, theirs = sides if pair[0] == image.name else sides[::-1]
        at, near = plane_geometry.under_pixels(
            structure, normal, k, view.pixels.from_original(theirs), reach_px=REACH_PX
        )
        xy.append(image.pixels.from_original(mine[near]))
        points.append(at)
    return np.concatenate(xy), np.concatenate(points)
