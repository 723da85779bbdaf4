"""Robust fundamental matrices and homographies for the benchmarks: OpenCV's MAGSAC++, seeded.

One estimator with one setting for every method compared, so that the rows differ in the matches
alone.
"""

from collections.abc import Callable

import cv2
import numpy as np

THRESHOLD_PX = 1.0
"""Of the estimator's inliers; MAGSAC++ marginalises over the noise below it."""
MAX_ITERATIONS = 20_000
CONFIDENCE = 0.9999


def _params(seed: int) -> cv2.UsacParams:
    params = cv2.UsacParams()
    params.threshold = THRESHOLD_PX
    params.maxIterations = MAX_ITERATIONS
    params.confidence = CONFIDENCE
    params.randomGeneratorState = seed
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.sampler = cv2.SAMPLING_UNIFORM
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    params.loIterations = 10
    params.loSampleSize = 50
    params.final_polisher = cv2.NONE_POLISHER
    params.isParallel = False
    return params


def _estimate(
    solve: Callable[..., tuple[np.ndarray | None, np.ndarray | None]],
    xy0: np.ndarray,
    xy1: np.ndarray,
    least: int,
    seed: int,
) -> np.ndarray | None:
    if len(xy0) < least:
        return None
    found, _ = solve(np.float64(xy0), np.float64(xy1), _params(seed))
    if found is None or found.shape != (3, 3) or not np.isfinite(found).all():
        return None
    return found


def fundamental_matrix(xy0: np.ndarray, xy1: np.ndarray, *, seed: int) -> np.ndarray | None:
    """F with x1' F x0 = 0 (float64 (3, 3)); None if there is none.

    Args:
      xy0, xy1: matches (n, 2), pixels.
    """
    return _estimate(cv2.findFundamentalMat, xy0, xy1, 8, seed)


def homography(xy0: np.ndarray, xy1: np.ndarray, *, seed: int) -> np.ndarray | None:
    """H with x1 ~ H x0 (float64 (3, 3)); None if there is none.

    Args:
      xy0, xy1: matches (n, 2), pixels.
    """
    return _estimate(cv2.findHomography, xy0, xy1, 4, seed)
