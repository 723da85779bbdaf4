"""Grey images that stay on the device from use to use."""

import copy
from collections import OrderedDict

from jaxsfm.io.photos import Reader
from jaxsfm.sfm.refine.padding import block_means, padded
from jaxsfm.sfm.refine.patch_alignment import PaddedImage

RESIDENT_BYTES = 1 << 29
"""Images on the device take at most so many bytes: 63 of 1600 x 1200."""


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
