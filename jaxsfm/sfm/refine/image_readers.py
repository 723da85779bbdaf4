"""Images at working size, and with keypoints in the few shapes that the compiled alignment
(`jaxsfm.core.align`) is compiled for."""

import functools
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from jaxsfm.config import Config
from jaxsfm.io import interrupt
from jaxsfm.io.images import ImageFile, read_image

ReadRgb = Callable[[str], tuple[np.ndarray, tuple[float, float]]]
"""Image name -> uint8 (h, w, 3) of the working image, original pixels per pixel."""
ReadGray = Callable[[str], tuple[np.ndarray, tuple[float, float]]]
"""Image name -> float32 (h, w) intensities of the working image, original pixels per pixel."""
GRAYS = 64
"""Intensities of images kept in memory: 8 MB each at 1600 x 1200."""
LUMA = np.asarray([0.299, 0.587, 0.114], np.float32)
"""Intensity of an RGB pixel (ITU-R BT.601)."""
CHUNK = 256
"""Keypoints aligned by one call of the compiled program. A keypoint takes 35 us with 128 to 1024 of
them, 47 with 4096, and most views of a large model have a few hundred in a block of points."""
PAD = 128
"""Maps are padded to multiples of this, so that few image sizes mean few compilations."""


def gray(rgb: np.ndarray) -> np.ndarray:
    """Intensities float32 (h, w) of an image uint8 (h, w, 3)."""
    return rgb.astype(np.float32) @ LUMA


def rgb_reader(files: Mapping[str, ImageFile], config: Config) -> ReadRgb:
    """Working images of files by name."""

    def read(name: str) -> tuple[np.ndarray, tuple[float, float]]:
        working = read_image(files[name], max_size=config.max_size, enlarge=config.enlarge)
        return working.rgb, working.scale

    return read


def gray_reader(files: Mapping[str, ImageFile], config: Config) -> ReadGray:
    """Intensities of working images by name; the last GRAYS stay in memory."""
    read_rgb = rgb_reader(files, config)

    @functools.lru_cache(maxsize=GRAYS)
    def read(name: str) -> tuple[np.ndarray, tuple[float, float]]:
        rgb, scale = read_rgb(name)
        return gray(rgb), scale

    return read


def padded(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An image (h, w) as a map (h', w', 1), and its valid size."""
    h, w = image.shape
    wide = np.pad(image, ((0, -h % PAD), (0, -w % PAD)))
    return wide[..., None], np.asarray([h, w], np.int32)


def chunks(rows: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Rows in pieces of CHUNK, the last one filled up with its first row, and how many count."""
    for start in range(0, len(rows), CHUNK):
        piece = rows[start : start + CHUNK]
        filled = np.full(CHUNK, piece[0])
        filled[: len(piece)] = piece
        interrupt.check()
        yield filled, len(piece)


def block_means(image: np.ndarray, px: int) -> np.ndarray:
    """The image with pixels `px` times as large; rows and columns that fill none are left out."""
    h, w = (side // px for side in image.shape)
    return image[: h * px, : w * px].reshape(h, px, w, px).mean((1, 3))
