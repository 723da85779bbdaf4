"""Grey images and templates that stay on the device, in few shapes.

Every new shape of an argument of `jaxsfm.core.align` is compiled anew. So images are padded, and
keypoints are aligned in chunks of a few lengths.
"""

import copy
import functools
from collections import OrderedDict
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsfm.core.align import Templates
from jaxsfm.io import interrupt
from jaxsfm.io.photos import Reader

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
RESIDENT_BYTES = 1 << 29
"""Images on the device take at most so many bytes: 63 of 1600 x 1200."""


class PaddedImage(NamedTuple):
    """An image on the device, in one of the few shapes that the alignment is compiled for."""

    map: jax.Array
    """float32 (h, w, 1), zero beyond the image."""
    size: jax.Array
    """int32 (2,): height and width of the image."""


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


class DeviceImages:
    """The grey images of a reader, padded and on the device, at any octave.

    An image is put on the device when it is taken, and stays there while there is room. If there is
    none, the image goes that was taken longest ago. So views are best taken forwards and backwards
    in turn: then the ones that were taken last are the first to be taken again.
    """

    def __init__(self, read: Reader, *, most_bytes: int = RESIDENT_BYTES) -> None:
        """Images by name. All octaves together take `most_bytes`, or one image if it is larger;
        one image more takes memory while it replaces another."""
        self._read, self._most, self._px = read, most_bytes, 1
        self._images: OrderedDict[tuple[str, int], PaddedImage] = OrderedDict()
        self._used = [0]  # one number for all octaves

    @property
    def nbytes(self) -> int:
        """Bytes of the images on the device."""
        return self._used[0]

    def octave(self, px: int) -> "DeviceImages":
        """The same images with pixels `px` times as large, in the same memory."""
        reduced = copy.copy(self)
        reduced._px = self._px * px
        return reduced

    def take(self, name: str) -> PaddedImage:
        """An image on the device. It raises what the reader raises."""
        key = name, self._px
        if key not in self._images:
            gray, _ = self._read(name)
            self._images[key] = padded(block_means(gray, self._px))
            self._used[0] += self._images[key].map.nbytes
        self._images.move_to_end(key)
        while len(self._images) > 1 and self.nbytes > self._most:
            _, gone = self._images.popitem(last=False)
            self._used[0] -= gone.map.nbytes
        return self._images[key]


class DeviceTemplates:
    """The templates of some of the points of a block, on the device.

    The number of templates that there is room for is a power of two, because the programs that
    write and gather are compiled for every such number.
    """

    def __init__(self, points: int, most: int) -> None:
        """Room for the templates of at most `most` out of `points` points."""
        self._room = 1 << (most + largest_chunk() - 1).bit_length()
        self._place = np.full(points, -1, np.int32)
        self._used = 0
        self._stored: Templates | None = None

    def put(self, points: np.ndarray, made: Templates) -> None:
        """Store templates. Rows of `made` behind those of the points (n,) count for nothing."""
        self._place[points] = self._used + np.arange(len(points))
        if self._stored is None:
            self._stored = _blank(made, room=self._room)
        self._stored = _written(self._stored, made, jax.device_put(np.int32(self._used)))
        self._used += len(points)

    def take(self, points: np.ndarray) -> Templates:
        """The templates of points (n,), in this order; each has been stored."""
        assert self._stored is not None
        return _gathered(self._stored, jax.device_put(self._place[points]))


@functools.partial(jax.jit, static_argnames="room")
def _blank(like: Templates, *, room: int) -> Templates:
    return jax.tree.map(lambda a: jnp.zeros((room, *a.shape[1:]), a.dtype), like)


@functools.partial(jax.jit, donate_argnums=0)
def _written(stored: Templates, made: Templates, at: jax.Array) -> Templates:
    """The same memory with some rows replaced, from row `at` (int32 scalar) on."""
    return jax.tree.map(
        lambda old, new: lax.dynamic_update_slice_in_dim(old, new, at, 0), stored, made
    )


@jax.jit
def _gathered(stored: Templates, rows: jax.Array) -> Templates:
    return jax.tree.map(lambda a: a.at[rows].get(mode="promise_in_bounds"), stored)
