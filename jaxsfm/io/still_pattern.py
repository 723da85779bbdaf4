"""What shows at the same pixels in all photos: a watermark, a dashboard, a wall behind a turntable.

It moves with the camera, so it is no part of a scene that the camera moves through, but it matches
perfectly. It is found by its fine structure: each photo, less its mean over 3 x 3 pixels, is
compared with a photo taken half of all photos later, at the same pixels. Around each pixel, the
correlation over all such pairs is 1 where the photos show the same, and near 0 where they do not,
whatever is there. Plain areas have only noise, which does not correlate either.
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.io.images import ImageError, ImageFile, read_image
from jaxsfm.io.photos import intensities

LEAST_PHOTOS = 8
"""Fewer photos say little: neighbouring frames of a video show nearly the same. Of runs of 5 to 10
successive frames of kitchen, half have an area with a correlation above `CORRELATION`."""
MOST_PHOTOS = 16
"""So many photos are compared, spread over all of them in the order of their names."""
SIDE = 400
"""Longer side of the photos when they are compared, pixels."""
WINDOW = 15
"""Side of the area over which the correlation is taken, pixels."""
CORRELATION = 0.7
"""A pixel is still if the correlation around it is higher. Of 20 sets of 8 photos or more with a
camera that moves or turns (Strecha, kitchen, drone, table, mug, photo site), the highest one of any
pixel is 0.48; letters written into them have 0.9 and more (docs/decisions/photos.md)."""
ROUNDING = 1 / 12
"""The variance of rounding to whole grey values. Pure black correlates with itself by no more."""


class StillPattern(NamedTuple):
    """Pixels at which all photos of one size show the same."""

    still: np.ndarray
    """bool (height, width), pixels as the photos are stored."""
    photos: int
    """The number of photos of this size."""

    @property
    def share(self) -> float:
        """The share of the pixels that are still."""
        return float(self.still.mean())

    def mask(self) -> bytes:
        """A PNG that masks the pixels, in COLMAP's convention: black pixels are not used."""
        ok, data = cv2.imencode(".png", np.where(self.still, 0, 255).astype(np.uint8))
        assert ok
        return data.tobytes()


def correlation(photos: np.ndarray) -> np.ndarray:
    """How alike the fine structure of photos is at the same pixels.

    Args:
      photos: float32 (n, height, width), grey values 0 .. 255; NaN where a photo is not used. The
        order matters: photo k is compared with photo k + n // 2, modulo n.

    Returns:
      float32 (height, width), about -1 .. 1.
    """
    fine = np.stack([np.nan_to_num(each - cv2.blur(each, (3, 3))) for each in photos])
    later = np.roll(fine, -(len(fine) // 2), axis=0)
    both, one = (cv2.blur(each.mean(0), (WINDOW, WINDOW)) for each in (fine * later, fine**2))
    return both / (one + ROUNDING)


def find_still_pattern(images: Sequence[ImageFile]) -> StillPattern | None:
    """What shows at the same pixels in all photos; None: nothing, or too few photos to tell.

    Only photos of the most frequent size are compared. Photos that cannot be read are left out.

    Args:
      images: sorted by name, so that photos that are far from each other were taken far apart.
    """
    sizes = Counter(image.size for image in images)
    size, count = max(sizes.items(), key=lambda each: (each[1], each[0]), default=((0, 0), 0))
    if count < LEAST_PHOTOS:
        return None
    alike = [image for image in images if image.size == size]
    at = np.linspace(0, count - 1, min(count, MOST_PHOTOS)).round().astype(int)
    read = [grey for k in at if (grey := _grey(alike[k])) is not None]
    if len(read) < LEAST_PHOTOS:
        return None
    still = correlation(np.stack(read)) > CORRELATION
    if not still.any():
        return None
    # What is still around a pixel belongs to it.
    wide = cv2.dilate(still.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8))
    whole = cv2.resize(wide, size, interpolation=cv2.INTER_NEAREST) > 0
    return StillPattern(whole, count)


def _grey(image: ImageFile) -> np.ndarray | None:
    """Grey values float32 (h, w) of a photo, NaN where it is not used; None: it cannot be read."""
    try:
        return intensities(read_image(image, max_size=SIDE))
    except ImageError:
        return None  # the description says so
