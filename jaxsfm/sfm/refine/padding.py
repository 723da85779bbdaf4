"""Images and keypoints in the few shapes that the alignment is compiled for.

Every new shape of an argument of `jaxsfm.core.align` is another compilation, so images are padded
and keypoints are aligned in chunks.
"""

from collections.abc import Iterator

import numpy as np

from jaxsfm.io import interrupt

CHUNK = 256
"""Keypoints aligned by one call of the compiled program. A keypoint takes 35 us with 128 to 1024 of
them, 47 with 4096, and most views of a large model have a few hundred in a block of points."""
PAD = 128
"""Maps are padded to multiples of this, so that few image sizes mean few compilations."""


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
