"""The metadata of a photo, as its file has them: EXIF and XMP."""

import contextlib
import warnings
from collections.abc import Callable
from typing import NamedTuple

from PIL import ExifTags

from jaxsfm.io import decoders
from jaxsfm.io.images import ImageFile, image_bytes


class ExifData(NamedTuple):
    """The EXIF data of a photo; empty where there are none, or they are damaged."""

    tags: dict[int, object]
    """The main directory and the directory of the exposure, together."""
    gps: dict[int, object]


def exif_data(image: ImageFile) -> ExifData:
    """Read the EXIF data of a photo. Raises ImageError if the file is gone or has changed."""
    found = ExifData({}, {})

    def read(header: decoders.Header) -> None:
        found.tags.update(decoders.exif_of(header))
        found.gps.update(header.getexif().get_ifd(ExifTags.IFD.GPSInfo))

    _read_header(image, read)
    return found


def xmp_data(image: ImageFile) -> bytes:
    """The XMP data of a photo; empty if there are none. Raises ImageError as `exif_data` does."""
    found = list[bytes]()

    def read(header: decoders.Header) -> None:
        info = getattr(header, "info", {})
        xmp = info.get("xmp") or info.get("XML:com.adobe.xmp") or b""
        found.append(xmp.encode() if isinstance(xmp, str) else bytes(xmp))

    _read_header(image, read)
    return b"".join(found)


def _read_header(image: ImageFile, read: Callable[[decoders.Header], None]) -> None:
    """Give the header of a photo to a function. What goes wrong there is dropped: odd metadata are
    not worth a failure."""
    data = image_bytes(image)
    with warnings.catch_warnings(), contextlib.suppress(Exception):  # see `inspect_image`
        warnings.simplefilter("ignore")
        with decoders.any_size(), decoders.open_header(data, image.path.suffix) as header:
            read(header)
