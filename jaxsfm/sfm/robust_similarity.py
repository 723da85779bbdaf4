"""The similarity on which most of some matched points agree."""

from typing import NamedTuple

import numpy as np

from jaxsfm.sfm.evaluation import Similarity, umeyama

HYPOTHESES = 1000
"""Three matches give a hypothesis. If a fifth of the matches is right, eight of a thousand are."""
FITS = 3
"""So often the best one is fitted to all that agrees with it."""


class RobustSimilarity(NamedTuple):
    """A similarity and what agrees with it."""

    similarity: Similarity
    inliers: np.ndarray
    """bool (n,)."""


def robust_similarity(
    source: np.ndarray, target: np.ndarray, *, max_error: float, seed: int
) -> RobustSimilarity:
    """Fit a similarity by RANSAC (Fischler and Bolles 1981), from three matches at a time.

    pycolmap's `estimate_sim3d_robust` finds nothing if the points lie on a plane.

    Args:
      source, target: float64 (n, 3), with n >= 3. They may lie on a plane.
      max_error: of an inlier, units of the target.

    Raises:
      ValueError: there are fewer than three points.
    """
    if len(source) < 3 or source.shape != target.shape:
        raise ValueError(
            f"source and target must be (n, 3) with n >= 3; got {source.shape} and {target.shape}"
        )

    def judged(rows: np.ndarray) -> RobustSimilarity:
        with np.errstate(invalid="ignore", divide="ignore"):  # three equal points
            found = umeyama(source[rows], target[rows])
            error = np.linalg.norm(found.apply(source) - target, axis=1)
        return RobustSimilarity(found, error < max_error)

    rng = np.random.default_rng(seed)
    drawn = (judged(rng.choice(len(source), 3, replace=False)) for _ in range(HYPOTHESES))
    best = max(drawn, key=lambda each: int(each.inliers.sum()))
    for _ in range(FITS):
        rows = np.flatnonzero(best.inliers)
        again = judged(rows) if len(rows) >= 3 else best
        if again.inliers.sum() < best.inliers.sum():
            break
        best = again
    return best
