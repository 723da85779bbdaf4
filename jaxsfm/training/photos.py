"""Square crops of photos, from which the views of each training step are made."""

import functools
from collections.abc import Sequence

import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile, read_image

MAX_SIZE = 1024
"""Longer side of the photos, pixels. At this size, a view of 192 pixels usually shows more than a
patch of wall."""
DECODED = 64
"""The number of decoded photos that are kept in memory, 2 MB each."""
HELD_OUT = 5
"""Every fifth photo is held out: it is not trained on, but used to measure the progress."""


def split(images: Sequence[ImageFile]) -> tuple[list[ImageFile], list[ImageFile]]:
    """Split photos into those to train on and those held out.

    The split depends on the content of the photos, not on their names or order. Raises UserError if
    there are fewer than two different photos.
    """
    different = sorted({image.sha256: image for image in images}.values(), key=lambda i: i.sha256)
    if len(different) < 2:
        raise UserError(
            f"--images: at least 2 different photos are needed, one of them to measure on; "
            f"got {len(different)}"
        )
    held_out = different[::HELD_OUT]
    return [image for image in different if image not in held_out], held_out


class Crops:
    """Random crops of photos, `side` pixels a side.

    Those of a step depend on the photos, the seed and the step alone.
    """

    def __init__(self, images: Sequence[ImageFile], *, side: int, seed: int) -> None:
        self._images = list(images)
        self._side, self._seed = side, seed
        self._read = functools.lru_cache(maxsize=DECODED)(self._decode)

    def _decode(self, index: int) -> np.ndarray:
        rgb = read_image(self._images[index], max_size=MAX_SIZE).rgb
        # Smaller photos are mirrored and not enlarged, because an enlarged photo has no fine detail
        # that could be found again.
        missing = [max(0, self._side - length) for length in rgb.shape[:2]]
        return np.pad(rgb, ((0, missing[0]), (0, missing[1]), (0, 0)), mode="symmetric")

    def draw(self, step: int, count: int) -> np.ndarray:
        """Draw the crops of a step, float32 (count, side, side, 3), RGB in 0 .. 255."""
        rng = np.random.default_rng([self._seed, step])
        crops = np.empty((count, self._side, self._side, 3), np.float32)
        for crop in crops:
            photo = self._read(int(rng.integers(len(self._images))))
            y, x = (int(rng.integers(length - self._side + 1)) for length in photo.shape[:2])
            crop[:] = photo[y : y + self._side, x : x + self._side]
            if rng.random() < 0.5:
                crop[:] = crop[:, ::-1].copy()
        return crops
