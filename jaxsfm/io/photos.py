"""The photos of a run at working size, views of a photo, and how their pixels lie on each other.

A view is a part of a photo, seen at another size, turned or slanted.

A photo is worked on at several sizes: as it is stored (the original), at working size, and at
octaves of it. In all of them the centre of the top-left pixel is (0, 0), so coordinates are scaled
about the corner of that pixel, which is (-0.5, -0.5). COLMAP puts the corner at (0, 0) instead.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile, WorkingImage, read_image, size_and_scale, working_size
from jaxsfm.io.orientation import UPRIGHT, to_stored

Reader = Callable[[str], tuple[np.ndarray, tuple[float, float]]]
"""A photo's name -> the pixels of its working image, and original pixels per working pixel."""
GRAYS = 64
"""Grey images that are kept in memory; one takes 8 MB at 1600 x 1200."""
LUMA = np.asarray([0.299, 0.587, 0.114], np.float32)
"""The weights of red, green and blue in the intensity of a pixel (ITU-R BT.601)."""
MIN_VIEWED = 64
"""Pixels: the shorter side of a photo is not reduced below it, whatever the view is."""


@dataclasses.dataclass(frozen=True)
class Pixels:
    """The pixels of a reduced (or enlarged) image, measured in pixels of the original."""

    scale: tuple[float, float]
    """Original pixels per pixel of the image, (x, y)."""

    @classmethod
    def octave(cls, px: float) -> "Pixels":
        """The pixels of an octave: each covers px x px pixels of the image it was made of."""
        return cls((px, px))

    def from_original(self, xy: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the original, in pixels of the image."""
        return (xy + 0.5) / np.asarray(self.scale) - 0.5

    def to_original(self, xy: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the image, in pixels of the original."""
        return (xy + 0.5) * np.asarray(self.scale) - 0.5

    def from_colmap(self, xy: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the original as COLMAP counts its pixels, in pixels of the image."""
        return xy / np.asarray(self.scale) - 0.5

    def to_colmap(self, xy: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the image, in pixels of the original as COLMAP counts them."""
        return (xy + 0.5) * np.asarray(self.scale)

    def matrix(self) -> np.ndarray:
        """`to_original` as a float64 matrix (3, 3) on homogeneous points (x, y, 1)."""
        sx, sy = self.scale
        return np.asarray([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1.0]])


def intensities(image: WorkingImage) -> np.ndarray:
    """The intensities float32 (h, w) of an image. They are NaN where pixels are not used, so that
    no patch with such a pixel agrees with another one."""
    gray = image.rgb.astype(np.float32) @ LUMA
    if image.used is not None:
        gray[~image.used] = np.nan
    return gray


class Photos:
    """Image files by name, and the size at which they are worked on.

    The reading methods raise ImageError if a file cannot be decoded or has changed.
    """

    def __init__(self, files: Iterable[ImageFile], config: Config) -> None:
        """Photos whose working size is given by `config.max_size` and `config.enlarge`."""
        self.files = {file.name: file for file in files}
        self._limits = config.max_size, config.enlarge
        # The cache belongs to the object, so that its images go when the object goes.
        self.gray = functools.lru_cache(maxsize=GRAYS)(self._gray)

    def median_scale(self) -> float:
        """The median over the photos of original pixels per working pixel, on the longer side."""
        sizes = [file.size for file in self.files.values()]
        return float(np.median([max(s) / max(working_size(s, *self._limits)) for s in sizes]))

    def working_size(self, name: str) -> tuple[tuple[int, int], tuple[float, float]]:
        """(width, height) of the working image; original pixels per working pixel, (x, y)."""
        return size_and_scale(self.files[name].size, *self._limits)

    def rgb(self, name: str) -> WorkingImage:
        """Colours uint8 (h, w, 3) of the working image; original pixels per working pixel."""
        max_size, enlarge = self._limits
        return read_image(self.files[name], max_size=max_size, enlarge=enlarge)

    def _gray(self, name: str) -> tuple[np.ndarray, tuple[float, float]]:
        """Intensities float32 (h, w) of the working image, NaN where pixels are not used; original
        pixels per working pixel."""
        image = self.rgb(name)
        return intensities(image), image.scale


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
