"""Hypothesis strategies: values are drawn, shapes come from a short menu (each shape compiles)."""

import numpy as np
from hypothesis import strategies as st

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
