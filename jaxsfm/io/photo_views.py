"""Views of a photo: a part of it, seen at another size, turned or slanted."""

import dataclasses
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.io.images import ImageFile, WorkingImage, read_image
from jaxsfm.io.orientation import UPRIGHT, to_stored
from jaxsfm.io.pixels import Pixels

MIN_VIEWED = 64
"""Pixels: the shorter side of a photo is not reduced below it, whatever the view is."""


class PhotoView(NamedTuple):
    """A part of a photo as another camera would see it if the part were flat and far away."""

    matrix: np.ndarray
    """float64 (3, 3): an affine map of the pixels of the upright photo to those of the view."""
    size: tuple[int, int]
    """(width, height), pixels."""

    def from_stored(self, image: ImageFile) -> np.ndarray:
        """The float64 matrix (3, 3) that maps pixels of the stored photo to those of the view."""
        return self.matrix @ np.linalg.inv(to_stored(image.size, image.orientation))

    @property
    def zoom(self) -> float:
        """Pixels of the view per pixel of the photo."""
        return float(np.sqrt(abs(np.linalg.det(self.matrix[:2, :2]))))

    def as_photo(self, image: ImageFile) -> ImageFile:
        """The view as a photo of its own, upright and of its size; its pixels are those of
        `read_view`."""
        return dataclasses.replace(image, size=self.size, orientation=UPRIGHT, mask=None)


def read_view(image: ImageFile, view: PhotoView) -> WorkingImage:
    """The pixels of a view; its scale is 1, and what lies outside the photo is not used.

    A view that is smaller than the photo is made of a reduced photo, whose pixels are means of the
    photo's, so that it does not alias.

    Raises:
      ImageError: the photo cannot be decoded.
    """
    longest = max(image.upright_size)
    # The photo is never reduced below the smallest working image.
    reduced = round(longest * min(view.zoom, 1.0))
    least = -(-MIN_VIEWED * longest // min(image.upright_size))
    working = read_image(image, max_size=max(reduced, min(least, longest)), upright=True)
    to_view = (view.matrix @ Pixels(working.scale).matrix())[:2]
    rgb = cv2.warpAffine(working.rgb, to_view, view.size, flags=cv2.INTER_CUBIC)
    height, width = working.rgb.shape[:2]
    used = np.ones((height, width), bool) if working.used is None else working.used
    inside = cv2.warpAffine(used.astype(np.uint8), to_view, view.size, flags=cv2.INTER_NEAREST) > 0
    return WorkingImage(rgb, (1.0, 1.0), None if inside.all() else inside)
