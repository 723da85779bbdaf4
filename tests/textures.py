"""Textures for photos of nothing in particular."""

import cv2
import numpy as np


def texture(seed: int, size: tuple[int, int]) -> np.ndarray:
    """Noise with the same contrast at all scales, as photos have it: float64 (height, width) of
    mean 0 and deviation about 1, for (width, height)."""
    random, (width, height) = np.random.default_rng(seed), size
    whole = np.zeros((height, width))
    for octave in range(8):
        noise = random.normal(size=(height >> octave, width >> octave))
        whole += cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC)
    return whole / whole.std()
