"""Where a photo shows the sky.

The sky has nothing to match, but the outline of a building before it looks the same from several
sides. The rule is simple and may take a white wall or a ceiling for the sky, so nothing is masked
by it unless something speaks against the model (`jaxsfm.runs.sky_masks`).
"""

import cv2
import numpy as np

from jaxsfm.io import orientation
from jaxsfm.io.images import ImageFile, read_image

SIDE = 800
"""The sky is looked for in photos of at most this size, longer side in pixels."""
BRIGHT = 150
"""The sky is brighter than this (grey, of 255), or blue."""
BLUER, BLUE = 15, 70
"""A blue sky has so much more blue than red, and more blue than the second number."""
FLAT, WINDOW = 40.0, 9
"""The sky has less than this mean magnitude of Sobel's gradient, in windows of so many pixels."""
TOP = 0.01
"""The sky reaches into this share of the photo's height, at the top."""
LEAST = 0.01
"""Each piece of the sky covers at least this share of the photo."""


def sky(rgb: np.ndarray) -> np.ndarray:
    """Which pixels of an upright photo show the sky, bool (h, w).

    These are smooth pieces that are bright or blue, and reach the upper border.

    Args:
      rgb: uint8 (h, w, 3).
    """
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    red, blue = rgb[..., 0].astype(np.float32), rgb[..., 2].astype(np.float32)
    slopes = (cv2.Sobel(gray, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1)))
    flat = cv2.blur(np.hypot(*slopes), (WINDOW, WINDOW)) < FLAT
    coloured = (gray > BRIGHT) | ((blue > red + BLUER) & (blue > BLUE))
    _, labels, stats, _ = cv2.connectedComponentsWithStats((flat & coloured).astype(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA]
    rows = max(1, round(TOP * len(rgb)))
    high = [k for k in np.unique(labels[:rows]) if k and areas[k] >= LEAST * gray.size]
    found = np.isin(labels, high).astype(np.uint8)
    # Noise leaves holes.
    return cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((WINDOW, WINDOW), np.uint8)) > 0


def below_sky(image: ImageFile) -> np.ndarray:
    """Which pixels of a photo do not show the sky: bool (h, w), as the photo is stored.

    Raises ImageError if the photo cannot be decoded.
    """
    rgb = read_image(image, max_size=SIDE, upright=True).rgb
    used = orientation.as_stored((~sky(rgb)).astype(np.uint8), image.orientation)
    return cv2.resize(used, image.size, interpolation=cv2.INTER_NEAREST) > 0
