"""The shapes and the memory of an image's features: buckets, so that few programs are compiled.

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
from jaxsfm.core.octaves import octave_capacity
from jaxsfm.core.types import DenseFeatures
from jaxsfm.errors import UserError
from jaxsfm.io.images import (
    ImageFile,
    shown_name,
    working_size,
)

SIDE_BUCKET = 128
"""Padding costs at most 8 % of a 1600 px side."""
BYTES_PER_PIXEL, OCTAVES_BYTES_PER_PIXEL = 700, 900
"""Peak memory of an extraction on CPUs per working pixel, with one octave and with four: between
800 x 600 and 1600 x 1200 it grows by 660 and 860 (measured, docs/performance.md)."""
PROCESS_BYTES = 900_000_000
"""Beside that: libraries and weights 0.3 GB, programs and their compilation 0.4 to 0.6 GB."""
_MENU = tuple(1024 * n // 2 for n in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64))
"""Coarse capacities: 512 .. 32768, half an octave apart."""


class FeatureCapacity(NamedTuple):
    """What fixes the shapes of a pair's program."""

    num_coarse: int
    """Capacity for coarse cells; there are four times as many fine ones."""
    columns: int
    """Of the coarse grid."""


class ImageFeatures(NamedTuple):
    """Features of one image and the way back to its original pixels."""

    image: ImageFile
    scale: tuple[float, float]
    """Original pixels per working pixel, (x, y)."""
    dense: DenseFeatures
    """numpy arrays."""

    @property
    def capacity(self) -> FeatureCapacity:
        """As `feature_capacity` the working image."""
        return FeatureCapacity(self.dense.coarse[0].shape[0], int(self.dense.coarse_grid[1]))


def padded_cells(num_coarse: int) -> int:
    """The smallest capacity of the menu that holds `num_coarse` cells (multiples of its largest
    beyond that)."""
    for size in _MENU:
        if num_coarse <= size:
            return size
    return -(-num_coarse // _MENU[-1]) * _MENU[-1]


def padded_size(size: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns), pixels, that a working image of (width, height) is padded to."""
    width, height = size
    return -(-height // SIDE_BUCKET) * SIDE_BUCKET, -(-width // SIDE_BUCKET) * SIDE_BUCKET


def feature_capacity(size: tuple[int, int]) -> FeatureCapacity:
    """For the cells of a working image of (width, height)."""
    width, height = size
    # 4 cells of pool3 to one of pool4, and the odd last row and column.
    odd = height // 8 * (width // 8) - 4 * (height // 16) * (width // 16)
    cells = height // 16 * (width // 16) + -(-odd // 4)
    return FeatureCapacity(padded_cells(cells), width // 16)


def image_capacity(image: ImageFile, *, config: Config) -> FeatureCapacity:
    """The room of an image's features, known before it is decoded."""
    return feature_capacity(working_size(image.size, config.max_size, config.enlarge))


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


def check_memory(image: ImageFile, at_once: int = 1, *, config: Config) -> None:
    """Refuse an image whose features cannot fit, before the system kills the process.

    Args:
      at_once: so many like it are computed together.

    Raises:
      UserError: what it needs and what there is.
    """
    width, height = working_size(image.size, config.max_size, config.enlarge)
    per_pixel = BYTES_PER_PIXEL if config.octaves == 1 else OCTAVES_BYTES_PER_PIXEL
    needed = PROCESS_BYTES + at_once * per_pixel * width * height
    total = total_memory() if jax.default_backend() == "cpu" else None
    if total is not None and needed > total:
        raise UserError(
            f"{shown_name(image.name)}: {width} x {height} working pixels need about "
            f"{needed / 1e9:.1f} GB of memory, there are {total / 1e9:.1f} GB; "
            "use a smaller --max-size"
        )
