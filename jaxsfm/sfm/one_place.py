"""Whether all photos were taken from one place: then nothing gives depth, and no model exists.

Two photos from one place are related by the homography H = K R K^-1 of a turn R, whatever they
show. So H aligns all of them, and its eigenvalues are those of a rotation, whose absolute values
are equal; this holds for any camera K that both photos share (Hartley and Zisserman, Multiple View
Geometry, section 13.4). A plane seen from two places gives a homography, too, but its eigenvalues
differ by about the baseline over the distance. Matches of low resolution are some pixels off and
would not tell: the homography is aligned on all pixels (Evangelidis and Psarakis 2008).
"""

from pathlib import Path

import cv2
import numpy as np

from jaxsfm.colmap.two_views import ImageKeypoints, read_inliers
from jaxsfm.io.images import ImageError
from jaxsfm.io.pairs import Pair
from jaxsfm.io.photos import Photos
from jaxsfm.sfm.limits import ONE_PLACE

ITERATIONS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-5)
SMOOTHINGS = (9, 5)
"""Sides of the Gaussian filters of the alignment, pixels: the first one bridges the errors of the
matches."""
WINDOW = 15
"""Side of the windows in which aligned photos are compared, pixels."""
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
    others, allowed = 0, (1 - ONE_PLACE.share) * len(at)
    for pair in (alike[k] for k in at):
        others += not _turned_only(pair, keypoints, matches[pair], photos)
        if others > allowed:
            return False
    return True


def _turned_only(
    pair: Pair, keypoints: dict[str, ImageKeypoints], matches: np.ndarray, photos: Photos
) -> bool:
    """Whether a turn of the camera aligns two photos."""
    try:
        (first, scale), (second, _) = (photos.gray(name) for name in pair)
    except ImageError:
        return False
    xy = [
        (keypoints[name].xy[matches[:, side]] + 0.5) / np.asarray(scale) - 0.5
        for side, name in enumerate(pair)
    ]
    start, _ = cv2.findHomography(*xy, cv2.RANSAC, ONE_PLACE.start_px)
    return start is not None and turn_aligns(first, second, start)


def turn_aligns(first: np.ndarray, second: np.ndarray, start: np.ndarray) -> bool:
    """Whether a homography near `start` aligns two photos, and is that of a turn.

    Args:
      first, second: grey values float32 (h, w), of one size; NaN where pixels are not used.
      start: float (3, 3), maps pixels of the first photo to those of the second one. Up to about
        half of the photos' smallest details, it may be off by `SMOOTHINGS`.
    """
    found = _aligned(first, second, start)
    if found is None or eigenvalue_spread(found) > ONE_PLACE.eigenvalues:
        return False
    alike = _alike(first, second, found)
    return len(alike) > 0 and float(np.mean(alike > ONE_PLACE.correlation)) >= ONE_PLACE.aligned


def eigenvalue_spread(homography: np.ndarray) -> float:
    """How far the eigenvalues of a homography (3, 3) are from those of a turn.

    Returns:
      the largest logarithm, up to its sign, of an eigenvalue's absolute value, if their product is
      1. It is 0 for a turn, and else about the baseline over the distance of what is seen.
    """
    values = np.abs(np.linalg.eigvals(homography))
    if not (values > 0).all():
        return np.inf
    logs = np.log(values)
    return float(np.abs(logs - logs.mean()).max())


def _aligned(first: np.ndarray, second: np.ndarray, start: np.ndarray) -> np.ndarray | None:
    """The homography that aligns the second photo with the first one; None: none does."""
    found, used = start.astype(np.float32), np.isfinite(second).astype(np.uint8)
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
