"""Speed and inliers of homographies next to OpenCV, with equal numbers of hypotheses."""

from collections.abc import Iterator

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.bench.speed.timing import Metric, median, ratio, seconds
from jaxsfm.config import PairShape
from jaxsfm.core.ransac import peel_planes
from jaxsfm.core.types import Thresholds

MATCHES, HYPOTHESES, THRESHOLD_PX = 5000, 2048, 10.0
INLIER_SHARE = 0.25


def _matches() -> tuple[np.ndarray, np.ndarray]:
    """Matches of one plane seen twice, with 1 px of noise, among random wrong matches."""
    rng = np.random.default_rng(0)
    h = np.asarray([[0.9, 0.1, 60], [-0.05, 1.05, 20], [4e-5, -3e-5, 1]])
    xy0 = rng.uniform([0, 0], [1536, 1024], size=(MATCHES, 2))
    projected = np.column_stack([xy0, np.ones(MATCHES)]) @ h.T
    xy1 = projected[:, :2] / projected[:, 2:] + rng.normal(size=(MATCHES, 2))
    wrong = rng.random(MATCHES) > INLIER_SHARE
    xy1[wrong] = rng.uniform([0, 0], [1536, 1024], size=(wrong.sum(), 2))
    return xy0.astype(np.float32), xy1.astype(np.float32)


def measure() -> Iterator[Metric]:
    """Time and inliers; neither side stops before it has tried all hypotheses."""
    xy0, xy1 = _matches()
    shape = PairShape(max_planes=1, max_hypotheses=HYPOTHESES)
    limits = Thresholds(jnp.float32(THRESHOLD_PX), jnp.int32(26), jnp.float32(1 - 1e-7))
    peel = jax.jit(
        lambda a, b: peel_planes(
            jax.random.key(0), a, b, jnp.ones(MATCHES, bool), limits, shape=shape
        )
    )
    a, b = jnp.asarray(xy0), jnp.asarray(xy1)

    def opencv(method: int) -> int:
        cv2.setRNGSeed(0)
        _, mask = cv2.findHomography(
            xy0, xy1, method, THRESHOLD_PX, maxIters=HYPOTHESES, confidence=1 - 1e-15
        )
        return int(mask.sum())

    ours, ransac, magsac = seconds(
        lambda: peel(a, b),
        lambda: opencv(cv2.RANSAC),
        lambda: opencv(cv2.USAC_MAGSAC),
        repeat=15,
    )
    found = peel(a, b)
    yield Metric("homography.seconds", median(ours), "s", "lower")
    yield Metric("homography.hypotheses", int(found.num_hypotheses[0]), "tried", "higher")
    yield ratio("homography.speed_over_opencv_ransac", ransac, ours, "higher", 0.25)
    yield ratio("homography.speed_over_opencv_magsac", magsac, ours, "higher", None)
    inliers = int(found.num_inliers[0])
    for name, method in (("ransac", cv2.RANSAC), ("magsac", cv2.USAC_MAGSAC)):
        share = inliers / max(opencv(method), 1)
        yield Metric(f"homography.inliers_over_opencv_{name}", share, "x", "higher", 0.02)
