"""Images and keypoints in the few shapes that the alignment is compiled for.

Every new shape of an argument of `jaxsfm.core.align` is compiled anew. So images are padded, and
keypoints are aligned in chunks of one length.
"""

from collections.abc import Iterator

import numpy as np

from jaxsfm.io import interrupt
from jaxsfm.sfm.refine.patch_alignment import PaddedImage

CHUNK = 256
"""Keypoints aligned by one call of the compiled program. A keypoint takes 35 us in chunks of 128 to
1024 and 47 us in chunks of 4096, and most views of a large model have a few hundred in a block."""
PAD = 128
"""The sides of maps are padded to multiples of this, so that there are few shapes."""


def padded(image: np.ndarray) -> PaddedImage:
    """Pad an image (h, w)."""
    h, w = image.shape
    wide = np.pad(image, ((0, -h % PAD), (0, -w % PAD)))
    return PaddedImage(wide[..., None], np.asarray([h, w], np.int32))


def chunks(rows: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Chunks of CHUNK indices (n,), filled up with their first one, and how many of each count."""
    for start in range(0, len(rows), CHUNK):
        piece = rows[start : start + CHUNK]
        filled = np.full(CHUNK, piece[0])
        filled[: len(piece)] = piece
        interrupt.check()
        yield filled, len(piece)


def block_means(image: np.ndarray, px: int) -> np.ndarray:
    """An image (h, w) with pixels `px` times as large, each the mean of those it covers.

    Rows and columns at the end that fill no large pixel are left out.
    """
    h, w = (side // px for side in image.shape)
    return image[: h * px, : w * px].reshape(h, px, w, px).mean((1, 3))
