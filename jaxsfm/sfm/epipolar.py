"""Robust fundamental matrices for `bench wxbs`: OpenCV's MAGSAC++ with a seed.

All methods that are compared have the same estimator with the same settings, so that only their
matches differ. A fundamental matrix is the best of several, after robust least squares over all
matches, because single ones differ more with the seed than methods do
(docs/decisions/benchmarks.md).
"""

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

THRESHOLD_PX = 1.0
"""Largest error of an inlier. MAGSAC++ marginalises over the noise below it."""
STARTS = 5
"""Number of fundamental matrices of MAGSAC++ that are refined. The best one is taken."""
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


def _estimate(xy0: np.ndarray, xy1: np.ndarray, seed: int) -> np.ndarray | None:
    if len(xy0) < 8:
        return None
    found, _ = cv2.findFundamentalMat(xy0, xy1, _params(seed))
    if found is None or found.shape != (3, 3) or not np.isfinite(found).all():
        return None
    return found


def epipolar_residuals(
    f: np.ndarray, xy0: np.ndarray, xy1: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The epipolar residuals of matches, and the squared norms of their epipolar lines' normals.

    Args:
      f: (3, 3), with x1' F x0 = 0.
      xy0, xy1: matches (n, 2), pixels.

    Returns:
      float64 (n,) x1' F x0; float64 (n,) squared norms in image 0; the same in image 1.
    """
    x0, x1 = (np.column_stack([xy, np.ones(len(xy))]) for xy in (xy0, xy1))
    line1, line0 = x0 @ f.T, x1 @ f
    norm0, norm1 = (np.square(line[:, :2]).sum(1) for line in (line0, line1))
    return (x1 * line1).sum(1), norm0, norm1


def sampson_error(f: np.ndarray, xy0: np.ndarray, xy1: np.ndarray) -> np.ndarray:
    """Signed first-order distance (n,) of matches (n, 2) to the nearest that fit F, pixels.

    Source: Hartley and Zisserman, 2nd edition, equation 11.9 (its root).
    """
    residual, norm0, norm1 = epipolar_residuals(f, xy0, xy1)
    return residual / np.sqrt(np.maximum(norm0 + norm1, np.finfo(float).tiny))


def _geman_mcclure(z: np.ndarray) -> np.ndarray:
    """The loss z / (1 + z) of squared errors, and two derivatives, in `least_squares`' form."""
    w = 1 / (1 + z)
    return np.stack([z * w, w**2, -2 * w**3])


def _to_pixels(xy: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) from coordinates of mean 0 and deviation 1 to pixels."""
    scale, (x, y) = max(xy.std(), 1e-9), xy.mean(axis=0)
    return np.asarray([[scale, 0, x], [0, scale, y], [0, 0, 1]])


def refine_fundamental_matrix(
    f: np.ndarray, xy0: np.ndarray, xy1: np.ndarray
) -> tuple[np.ndarray, float]:
    """Refine a fundamental matrix by robust least squares of Sampson errors.

    The loss is Geman-McClure's at THRESHOLD_PX, which wrong matches hardly change. F has seven
    degrees of freedom: two orthogonal matrices and the ratio of the singular values.

    Source: Bartoli and Sturm 2004, "Nonlinear estimation of the fundamental matrix with minimal
    parameters".

    Returns:
      float64 (3, 3); the loss that is left.
    """
    to0, to1 = _to_pixels(xy0), _to_pixels(xy1)
    u, s, vt = np.linalg.svd(to1.T @ f @ to0)
    angle, back0, back1 = np.arctan2(s[1], s[0]), np.linalg.inv(to0), np.linalg.inv(to1)

    def matrix(step: np.ndarray) -> np.ndarray:
        turned0, turned1 = (Rotation.from_rotvec(w).as_matrix() for w in (step[:3], step[3:6]))
        values = np.diag([np.cos(angle + step[6]), np.sin(angle + step[6]), 0])
        return back1.T @ (turned1 @ u @ values @ vt @ turned0) @ back0

    found = least_squares(
        lambda step: sampson_error(matrix(step), xy0, xy1),
        np.zeros(7),
        loss=_geman_mcclure,  # pyright: ignore[reportArgumentType]
        f_scale=THRESHOLD_PX,
        max_nfev=50,
    )
    return matrix(found.x), float(found.cost)


def fundamental_matrix(xy0: np.ndarray, xy1: np.ndarray, *, seed: int) -> np.ndarray | None:
    """The F (float64 (3, 3)) with x1' F x0 = 0 of matches (n, 2), pixels; None if there is none."""
    xy0, xy1 = np.asarray(xy0, np.float64), np.asarray(xy1, np.float64)
    seeds = np.random.SeedSequence(seed).generate_state(STARTS)
    starts = [_estimate(xy0, xy1, int(s >> 1)) for s in seeds]
    refined = [refine_fundamental_matrix(f, xy0, xy1) for f in starts if f is not None]
    return min(refined, key=lambda found: found[1])[0] if refined else None


def single_fundamental_matrix(xy0: np.ndarray, xy1: np.ndarray) -> np.ndarray | None:
    """The F of one run of OpenCV's MAGSAC++ as others report it for WxBS: 0.25 px and 100,000
    iterations. OpenCV seeds it itself. None if there is none."""
    if len(xy0) < 8:
        return None
    xy0, xy1 = np.asarray(xy0, np.float64), np.asarray(xy1, np.float64)
    found, _ = cv2.findFundamentalMat(xy0, xy1, cv2.USAC_MAGSAC, 0.25, 0.999999, 100_000)
    return None if found is None or found.shape != (3, 3) else found
