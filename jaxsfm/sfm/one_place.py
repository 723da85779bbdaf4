"""Whether all photos were taken from one place: then nothing gives depth, and no model exists.

Two photos from one place are related by the homography H = K R K^-1 of a turn R, whatever they
show, if one camera K took both (Hartley and Zisserman, Multiple View Geometry, section 13.4). So

* H aligns all of both photos;
* the eigenvalues of H are those of R: their absolute values are equal, whatever K is;
* K^-1 H K is a rotation: its singular values are equal, for the same focal length in all pairs.

A plane seen from two places gives a homography, too. Its eigenvalues differ by about the baseline
over the distance, or, if the camera moves along the plane without turning, its singular values do.
Matches of low resolution are some pixels off and would not tell: the homography is aligned on all
pixels (Evangelidis and Psarakis 2008).
"""

from pathlib import Path

import cv2
import numpy as np

from jaxsfm.colmap.two_views import ImageKeypoints, read_inliers
from jaxsfm.io.images import ImageError
from jaxsfm.io.pairs import Pair
from jaxsfm.io.photos import Photos, Pixels
from jaxsfm.sfm.limits import ONE_PLACE

ITERATIONS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-5)
SMOOTHINGS = (9, 5)
"""Sides of the Gaussian filters of the alignment, pixels: the first one bridges the errors of the
matches."""
WINDOW = 15
"""Side of the windows in which aligned photos are compared, pixels."""
FOCALS = 1.05 ** np.arange(-24, 25)
"""Focal lengths in longer sides of the photos: angles of view of 116 to 18 degrees. Longer ones
would explain any small shift by a turn."""
TEXTURE = 5.0
"""Windows with a smaller standard deviation of the grey values are plain: what is alike in them may
be noise."""


def from_one_place(database: Path, photos: Photos) -> bool:
    """Whether verified pairs, spread over all of them, differ by a turn of the camera alone.

    Photos of different sizes are not compared, and a photo that cannot be read says nothing.

    Args:
      database: verified matches; original pixels.
      photos: at the size at which they were described.
    """
    keypoints, matches = read_inliers(database)
    alike = [pair for pair in sorted(matches) if keypoints[pair[0]].size == keypoints[pair[1]].size]
    if not alike:
        return False
    at = np.linspace(0, len(alike) - 1, min(len(alike), ONE_PLACE.pairs)).round().astype(int)
    needed, turns = ONE_PLACE.share * len(at), list[np.ndarray]()
    for tried, pair in enumerate(alike[k] for k in at):
        found = _turn(pair, keypoints, matches[pair], photos)
        if found is not None:
            turns.append(found)
        if len(turns) + len(at) - tried - 1 < needed:
            return False  # most runs end here, after few pairs
    fits = np.asarray(turns) <= ONE_PLACE.singular_values
    return bool(fits.sum(0).max() >= needed)


def _turn(
    pair: Pair, keypoints: dict[str, ImageKeypoints], matches: np.ndarray, photos: Photos
) -> np.ndarray | None:
    """`singular_spreads` of the homography of a turn between two photos; None: there is none."""
    try:
        (first, scale), (second, _) = (photos.gray(name) for name in pair)
    except ImageError:
        return None
    a, b = (
        Pixels(scale).from_original(keypoints[name].xy[matches[:, side]])
        for side, name in enumerate(pair)
    )
    start, _ = cv2.findHomography(a, b, cv2.RANSAC, ONE_PLACE.start_px)
    found = None if start is None else turn_between(first, second, start)
    return None if found is None else singular_spreads(found, first.shape)


def turn_between(first: np.ndarray, second: np.ndarray, start: np.ndarray) -> np.ndarray | None:
    """The homography that aligns two photos, if there is one with the eigenvalues of a turn.

    Args:
      first, second: grey values float32 (h, w), of one size; NaN where pixels are not used.
      start: float (3, 3), maps pixels of the first photo to those of the second one, up to a few
        pixels.

    Returns:
      float64 (3, 3), as `start`; None: there is none.
    """
    found = _aligned(first, second, start)
    if found is None or eigenvalue_spread(found) > ONE_PLACE.eigenvalues:
        return None
    alike = _alike(first, second, found)
    aligned = len(alike) and np.mean(alike > ONE_PLACE.correlation) >= ONE_PLACE.aligned
    return found if aligned else None


def eigenvalue_spread(homography: np.ndarray) -> float:
    """How far the eigenvalues of a homography (3, 3) are from those of a turn.

    Returns:
      the largest logarithm, up to its sign, of an eigenvalue's absolute value, if their product is
      1. It is 0 for a turn, and else about the baseline over the distance of what is seen.
    """
    return float(_spread(np.abs(np.linalg.eigvals(homography))))


def singular_spreads(homography: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """How far a homography (3, 3) is from a turn of cameras with the focal lengths `FOCALS`.

    Args:
      shape: (height, width) of the photos, pixels. Their centre is the principal point.

    Returns:
      float64 (number of `FOCALS`,): the largest logarithm, up to its sign, of a singular value of
      K^-1 H K, if their product is 1. It is 0 for a turn.
    """
    height, width = shape[:2]
    focals = FOCALS * max(width, height)
    camera = np.zeros((len(focals), 3, 3))
    camera[:, 0, 0] = camera[:, 1, 1] = focals
    camera[:, :, 2] = (width - 1) / 2, (height - 1) / 2, 1
    return _spread(np.linalg.svd(np.linalg.solve(camera, homography @ camera), compute_uv=False))


def _spread(values: np.ndarray) -> np.ndarray:
    """The largest logarithm, up to its sign, of numbers (..., 3) that are scaled to the product 1;
    infinite if one is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(values)
        spread = np.abs(logs - logs.mean(-1, keepdims=True)).max(-1)
    return np.where(np.isnan(spread), np.inf, spread)


def _aligned(first: np.ndarray, second: np.ndarray, start: np.ndarray) -> np.ndarray | None:
    """The homography that aligns the second photo with the first one; None: none does."""
    found = start.astype(np.float32)
    there = cv2.warpPerspective(np.isfinite(first).astype(np.uint8), start, first.shape[::-1])
    used = there * np.isfinite(second)
    first, second = np.nan_to_num(first), np.nan_to_num(second)
    try:
        for size in SMOOTHINGS:
            how = cv2.MOTION_HOMOGRAPHY, ITERATIONS, used, size
            _, found = cv2.findTransformECC(first, second, found, *how)
    except cv2.error:  # it does not converge, or the photos do not overlap
        return None
    found = found.astype(np.float64)
    return found if np.isfinite(found).all() else None


def _alike(first: np.ndarray, second: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """The correlations of windows with texture, after the second photo was aligned."""
    size, inverse = first.shape[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpPerspective(
        second, homography, size, flags=inverse, borderValue=(np.nan, np.nan, np.nan, np.nan)
    )
    used = np.isfinite(first) & np.isfinite(moved)
    a, b = (cv2.GaussianBlur(np.where(used, each, 0), (0, 0), 1) for each in (first, moved))

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values.astype(np.float64), (WINDOW, WINDOW))

    variances = [mean(each**2) - mean(each) ** 2 for each in (a, b)]
    whole = (mean(used) > 0.999) & (np.minimum(*variances) > TEXTURE**2)
    product = np.sqrt(np.maximum(variances[0] * variances[1], 1e-9))
    return ((mean(a * b) - mean(a) * mean(b)) / product)[whole]
