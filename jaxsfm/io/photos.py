"""The photos of a run and the readers of their pixels at working size."""

import functools
from collections.abc import Callable, Iterable

import numpy as np

from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile, WorkingImage, read_image, size_and_scale, working_size

Reader = Callable[[str], tuple[np.ndarray, tuple[float, float]]]
"""A photo's name -> the pixels of its working image, and original pixels per working pixel."""
GRAYS = 64
"""Grey images that are kept in memory; one takes 8 MB at 1600 x 1200."""
LUMA = np.asarray([0.299, 0.587, 0.114], np.float32)
"""The weights of red, green and blue in the intensity of a pixel (ITU-R BT.601)."""


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
