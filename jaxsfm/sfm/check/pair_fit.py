"""Whether matched pairs agree with a model: where their matches fall on its surface."""

from collections.abc import Iterable, Mapping

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.limits import CHECK
from jaxsfm.sfm.refine.evidence import MATCH_ERROR_PX, matched_points


def pair_fits(
    model: Model, normal: np.ndarray, matches: Mapping[Pair, PairResult], pairs: Iterable[Pair]
) -> dict[Pair, float]:
    """The share of each pair's matches that the model explains.

    A match of two keypoints fits if the surface under one keypoint is projected to the other one,
    within `MATCH_ERROR_PX`. Unlike rotations and epipolar lines, this tells a step of one house to
    the left from a step of two houses to the right.

    Args:
      normal: float64 (points, 3), of the model's points.
      matches: original pixels.
      pairs: only these are looked at.

    Returns:
      the shares, for the pairs whose two images are in the model and that have enough matches on
      its surface.
    """
    index = {view.name: k for k, view in enumerate(model.views)}
    found = {}
    for pair in sorted(pairs):
        if not index.keys() >= set(pair):
            continue
        one, own = {pair: matches[pair]}, 0
        fitting = 0
        for name in pair:
            view = model.views[index[name]]
            xy, points = matched_points(view, model, normal, one)
            at, _ = view.project(points)
            own += len(xy)
            fitting += int((np.linalg.norm(at - xy, axis=1) < MATCH_ERROR_PX).sum())
        if own >= 2 * CHECK.least_matches:
            found[pair] = fitting / own
    return found
