"""The features of one image, the sizes to which they are padded, and the memory they need.

A program is compiled for each shape of its arrays. To need few programs, each side of an image is
padded to a multiple of `SIDE_BUCKET` pixels, and the number of its cells to one of a few
capacities. Both depend on the size of the image alone, so the features of an image do not depend on
the other images.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from jaxsfm.config import Config
from jaxsfm.core.grid import FINE_STRIDE
from jaxsfm.core.octaves import octave_capacity
from jaxsfm.core.types import DenseFeatures
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile, shown_name, working_size
from jaxsfm.io.libraries import total_memory
from jaxsfm.io.masks import used_cells
from jaxsfm.io.orientation import to_stored
from jaxsfm.io.photos import Pixels

SIDE_BUCKET = 32
"""Pixels. Photos with 800 pixels on the longer side get 2 % more pixels on average. With 128 they
would get 30 % more, and photos of one camera need a single program anyway."""
LEAST_SIDE = 128
"""The fourth octave of a shorter side would have no coarse cell, and its map would be empty."""
BYTES_PER_PIXEL, OCTAVES_BYTES_PER_PIXEL = 700, 900
"""Peak memory of the extraction on a CPU, for each pixel of the working image, with one octave and
with four. Between 800 x 600 and 1600 x 1200 pixels it grows by 660 and 860 bytes per pixel
(docs/performance.md)."""
PROCESS_BYTES = 900_000_000
"""Memory that the process needs besides: 0.3 GB for libraries and weights, and 0.4 to 0.6 GB for
programs and their compilation."""
_MENU = tuple(1024 * n // 2 for n in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64))
"""The capacities for coarse cells: 512 .. 32768, each about 1.4 times the one before."""


class FeatureCapacity(NamedTuple):
    """The padded size of an image's features; the program that matches a pair depends on it."""

    num_coarse: int
    """The capacity for coarse cells; that for fine cells is four times as large."""
    columns: int
    """The number of columns of the coarse grid."""


class ImageFeatures(NamedTuple):
    """The features of one image, and how its upright working image lies on the stored one."""

    image: ImageFile
    scale: tuple[float, float]
    """Original pixels per working pixel, (x, y), both of the upright photo."""
    dense: DenseFeatures
    """The features of the upright photo; the arrays are numpy arrays."""

    def to_stored(self) -> np.ndarray:
        """The float64 matrix (3, 3) that maps working pixels to the pixels of the stored photo."""
        return to_stored(self.image.size, self.image.orientation) @ Pixels(self.scale).matrix()

    @property
    def capacity(self) -> FeatureCapacity:
        """The capacity to which these features are padded."""
        return FeatureCapacity(self.dense.coarse[0].shape[0], int(self.dense.coarse_grid[1]))


def padded_cells(num_coarse: int) -> int:
    """The smallest capacity that holds `num_coarse` coarse cells.

    Beyond the largest capacity of the menu, it is a multiple of that one.
    """
    for size in _MENU:
        if num_coarse <= size:
            return size
    return -(-num_coarse // _MENU[-1]) * _MENU[-1]


def padded_size(size: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns), in pixels, to which a working image of (width, height) is padded."""
    width, height = (max(-(-side // SIDE_BUCKET) * SIDE_BUCKET, LEAST_SIDE) for side in size)
    return height, width


def feature_capacity(size: tuple[int, int], *, fine_stride: int = FINE_STRIDE) -> FeatureCapacity:
    """The capacity for the features of a working image of (width, height)."""
    coarse_columns, coarse_rows = (side // (2 * fine_stride) for side in size)
    columns, rows = (side // fine_stride for side in size)
    # Four fine cells belong to each coarse cell; an odd last row and column come on top.
    odd = rows * columns - 4 * coarse_rows * coarse_columns
    cells = coarse_rows * coarse_columns + -(-odd // 4)
    return FeatureCapacity(padded_cells(cells), coarse_columns)


def image_capacity(image: ImageFile, *, config: Config) -> FeatureCapacity:
    """The capacity for the features of an image; it is known before the image is decoded."""
    size = working_size(image.upright_size, config.max_size, config.enlarge)
    return feature_capacity(size, fine_stride=config.fine_stride)


def pad_features(dense: DenseFeatures, num_coarse: int) -> DenseFeatures:
    """Pad features to `num_coarse` coarse cells and four times as many fine cells."""

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


def without_unused(dense: DenseFeatures, used: np.ndarray) -> DenseFeatures:
    """Features without those of unused pixels, whose descriptors become zero: they never match.

    A fine cell goes if its keypoint is unused, a coarse cell if all its fine cells are.

    Args:
      dense: numpy arrays.
      used: bool (h, w), of the image that was described.
    """
    (rows, columns), (coarse_rows, coarse_columns) = dense.fine_grid, dense.coarse_grid
    cells = int(rows) * int(columns)
    fine = used_cells(used, np.asarray(dense.keypoints[:cells])).reshape(rows, columns)
    parts = fine[: 2 * coarse_rows, : 2 * coarse_columns]
    coarse = parts.reshape(coarse_rows, 2, coarse_columns, 2).any((1, 3)).reshape(-1)
    for keep, octaves in ((fine.reshape(-1), dense.fine), (coarse, dense.coarse)):
        octaves[0][: len(keep)][~keep] = 0
    return dense


def check_memory(image: ImageFile, at_once: int = 1, *, config: Config) -> None:
    """Refuse an image whose features do not fit into memory, before the system kills the process.

    Args:
      at_once: the number of such images that are computed together.

    Raises:
      UserError: there is too little memory; the message gives both numbers.
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
