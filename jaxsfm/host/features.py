"""From image files to DenseFeatures: shape buckets, so that few programs are compiled.

An image is padded to a multiple of `SIDE_BUCKET` pixels per side and its cells to a menu of
capacities. Both follow from the image's own size alone, so what is computed for an image never
depends on the other images.
"""

import os
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from jaxsfm.config import Config
from jaxsfm.core.features import extract
from jaxsfm.core.octaves import octave_capacity
from jaxsfm.core.types import DenseFeatures
from jaxsfm.errors import UserError
from jaxsfm.host.images import (
    ImageFile,
    WorkingImage,
    read_image,
    shown_name,
    working_size,
)
from jaxsfm.host.weights import Weights

SIDE_BUCKET = 128
"""Padding costs at most 8 % of a 1600 px side."""
BYTES_PER_PIXEL = 2100
"""Peak memory of an extraction on CPUs; measured 1670 at 800 x 600, 1280 at 3200 x 2432, before
Winograd's convolution, which adds 410 and 280 (the compiled programs' own figures)."""
OCTAVES_BYTES_PER_PIXEL = 2900
"""The same with four octaves; measured 2400 at 800 x 600, 1830 at 1600 x 1200, with 460 and 360 to
add."""
_MENU = tuple(1024 * n // 2 for n in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64))
"""Coarse capacities: 512 .. 32768, half an octave apart."""


class ImageFeatures(NamedTuple):
    """Features of one image and the way back to its original pixels."""

    image: ImageFile
    scale: tuple[float, float]
    """Original pixels per working pixel, (x, y)."""
    dense: DenseFeatures
    """numpy arrays."""


def capacity(num_coarse: int) -> int:
    """The smallest capacity of the menu that holds `num_coarse` cells (multiples of its largest
    beyond that)."""
    for size in _MENU:
        if num_coarse <= size:
            return size
    return -(-num_coarse // _MENU[-1]) * _MENU[-1]


def compute_features(weights: Weights, working: WorkingImage, *, config: Config) -> DenseFeatures:
    """DenseFeatures (numpy) of an image at working size."""
    height, width = working.rgb.shape[:2]
    padded = tuple(-(-side // SIDE_BUCKET) * SIDE_BUCKET for side in (height, width))
    image = np.zeros((*padded, 3), np.uint8)
    image[:height, :width] = working.rgb
    # 4 cells of pool3 to one of pool4, and the odd last row and column.
    odd = height // 8 * (width // 8) - 4 * (height // 16) * (width // 16)
    num_coarse = capacity(height // 16 * (width // 16) + -(-odd // 4))
    dense = extract(
        weights.params,
        image,
        np.asarray([height, width], np.int32),
        preprocessing=weights.preprocessing,
        num_coarse=num_coarse,
        num_fine=4 * num_coarse,
        relocalized=config.keypoints == "relocalized",
        octaves=config.octaves,
        centred=config.centred,
    )
    return jax.device_get(dense)


def pad_features(dense: DenseFeatures, num_coarse: int) -> DenseFeatures:
    """The same features with room for `num_coarse` coarse and 4 x as many fine cells."""

    def pad(array: Array, rows: int) -> np.ndarray:
        return np.pad(np.asarray(array), ((0, rows - array.shape[0]), (0, 0)))

    def pad_octaves(octaves: tuple[Array, ...], rows: int) -> tuple[np.ndarray, ...]:
        return tuple(pad(array, octave_capacity(rows, k)) for k, array in enumerate(octaves))

    if dense.coarse[0].shape[0] == num_coarse:
        return dense
    return dense._replace(
        coarse=pad_octaves(dense.coarse, num_coarse),
        fine=pad_octaves(dense.fine, 4 * num_coarse),
        keypoints=pad(dense.keypoints, 4 * num_coarse),
    )


def total_memory() -> int | None:
    """Bytes this process may use at all; None where the system does not tell.

    The total and not what is free just now: a result must not depend on other processes.
    """
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None
    try:
        total = min(total, int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    except (OSError, ValueError):  # no limit ("max"), or another system
        pass
    return total


def check_memory(image: ImageFile, *, config: Config) -> None:
    """Refuse an image whose features cannot fit, before the system kills the process.

    Raises:
      UserError: what it needs and what there is.
    """
    width, height = working_size(image.size, config.max_size, config.enlarge)
    per_pixel = BYTES_PER_PIXEL if config.octaves == 1 else OCTAVES_BYTES_PER_PIXEL
    needed = per_pixel * width * height
    total = total_memory() if jax.default_backend() == "cpu" else None
    if total is not None and needed > total:
        raise UserError(
            f"{shown_name(image.name)}: {width} x {height} working pixels need about "
            f"{needed / 1e9:.1f} GB of memory, there are {total / 1e9:.1f} GB; "
            "use a smaller --max-size"
        )


def image_features(weights: Weights, image: ImageFile, *, config: Config) -> ImageFeatures:
    """Read one image and compute its features.

    Raises:
      ImageError: the image cannot be used.
      UserError: it needs more memory than there is.
    """
    check_memory(image, config=config)
    working = read_image(image, max_size=config.max_size, enlarge=config.enlarge)
    return ImageFeatures(image, working.scale, compute_features(weights, working, config=config))
