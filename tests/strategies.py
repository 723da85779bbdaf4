"""Hypothesis strategies: values are drawn, shapes come from a short menu (each shape compiles)."""

import numpy as np
from hypothesis import strategies as st

from jaxsfm.core.types import DenseFeatures

seeds = st.integers(0, 2**32 - 1)


def rng_of(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def unit_rows(rng: np.random.Generator, n: int, c: int) -> np.ndarray:
    """Random unit descriptors, non-negative as after a rectifier."""
    x = np.abs(rng.normal(size=(n, c))).astype(np.float32)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def random_homography(rng: np.random.Generator, *, strength: float) -> np.ndarray:
    """A map of a 1000 px image that moves its corners by up to strength * 200 px; 0: identity."""
    corners = np.asarray([[0, 0], [1000, 0], [1000, 1000], [0, 1000]], np.float32)
    moved = corners + (rng.uniform(-200, 200, (4, 2)) * strength).astype(np.float32)
    import cv2

    return cv2.getPerspectiveTransform(corners, moved)


homographies = st.builds(
    lambda seed, strength: random_homography(rng_of(seed), strength=strength),
    seeds,
    st.sampled_from([0.0, 1e-4, 0.1, 1.0]),
)
"""Identity, nearly identity, mild and strong."""


def random_features(seed: int, shape: tuple[int, int], octaves: int) -> DenseFeatures:
    """Unit descriptors, some of them blank, in more room than there are cells."""
    rng = rng_of(seed)

    def levels(grid, room):
        for k in range(octaves):
            cells = (grid[0] >> k) * (grid[1] >> k)
            x = rng.normal(size=(cells, 6)) * (rng.random((cells, 1)) > 0.1)
            x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
            yield np.float32(np.pad(x, ((0, -(-room // 4**k) - cells), (0, 0))))

    fine = (2 * shape[0] + 1, 2 * shape[1])
    return DenseFeatures(
        tuple(levels(shape, 112)),
        tuple(levels(fine, 448)),
        np.zeros((448, 2), np.float32),
        np.int32(shape),
        np.int32(fine),
    )
