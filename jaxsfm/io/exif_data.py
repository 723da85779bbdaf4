"""The EXIF data of a photo, as its file has them."""

import contextlib
import warnings
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
    data, found = image_bytes(image), ExifData({}, {})
    with warnings.catch_warnings(), contextlib.suppress(Exception):  # see `inspect_image`
        warnings.simplefilter("ignore")
        with decoders.any_size(), decoders.open_header(data, image.path.suffix) as header:
            found.tags.update(decoders.exif_of(header))
            found.gps.update(header.getexif().get_ifd(ExifTags.IFD.GPSInfo))
    return found
