"""Images and keypoints in the few shapes that the alignment is compiled for.

Every new shape of an argument of `jaxsfm.core.align` is compiled anew. So images are padded, and
keypoints are aligned in chunks of a few lengths.
"""

from collections.abc import Iterator

import jax
import numpy as np

from jaxsfm.io import interrupt
from jaxsfm.sfm.refine.patch_alignment import PaddedImage

CHUNK = 256
"""Keypoints aligned by one call of the compiled program on a CPU. A keypoint takes 35 us in chunks
of 128 to 1024 and 47 us in chunks of 4096, and most views of a large model have a few hundred in a
block."""
FEW = 64
"""So many keypoints, or fewer, are aligned by a call of this length. In a street of 100 photos, a
test of a second place made 43 calls for templates, most of which were mostly filling."""
ACCELERATOR_FACTOR = 8
"""An accelerator aligns up to so many times as many keypoints by one call. Its lanes are filled by
the samples of about 2000 patches. The factor changes no result, and it has not been measured."""
PAD = 128
"""The sides of maps are padded to multiples of this, so that there are few shapes."""


def padded(image: np.ndarray) -> PaddedImage:
    """Pad an image float32 (h, w), and put it on the device."""
    h, w = image.shape
    wide = np.pad(image, ((0, -h % PAD), (0, -w % PAD)))
    return PaddedImage(*jax.device_put((wide[..., None], np.asarray([h, w], np.int32))))


def largest_chunk() -> int:
    """The largest number of keypoints of a call on the platform that JAX uses."""
    return CHUNK if jax.default_backend() == "cpu" else ACCELERATOR_FACTOR * CHUNK


def chunks(rows: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Chunks of indices (n,), filled up with their first one, and how many of each count.

    The last chunk has FEW, or CHUNK times the power of two that holds it, so that calls have few
    lengths, and a short one is not mostly filling.
    """
    largest = largest_chunk()
    for start in range(0, len(rows), largest):
        piece = rows[start : start + largest]
        length = FEW if len(piece) <= FEW else CHUNK << ((len(piece) - 1) // CHUNK).bit_length()
        filled = np.full(length, piece[0])
        filled[: len(piece)] = piece
        interrupt.check()
        yield filled, len(piece)


def block_means(image: np.ndarray, px: int) -> np.ndarray:
    """An image (h, w) with pixels `px` times as large, each the mean of those it covers.

    Rows and columns at the end that fill no large pixel are left out. A large pixel is the mean of
    the used pixels, and is not used (NaN) itself if less than half of it is.
    """
    if px == 1:
        return image
    h, w = (side // px for side in image.shape)
    blocks = image[: h * px, : w * px].reshape(h, px, w, px)
    if not np.isnan(blocks).any():
        return blocks.mean((1, 3))
    used = np.isfinite(blocks)
    count = used.sum((1, 3))
    total = np.where(used, blocks, 0).sum((1, 3))
    return np.where(2 * count >= px * px, total / np.maximum(count, 1), np.nan).astype(image.dtype)
