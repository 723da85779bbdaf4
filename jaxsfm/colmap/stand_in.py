"""A file from which COLMAP reads the camera of a photo whose format it does not know.

COLMAP 4.2 reads neither HEIC nor camera RAW. Its guess of a focal length, from EXIF and from its
list of sensor widths, needs the size of the photo and a few EXIF tags but not the pixels.
"""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image

from jaxsfm.io.decoders import BRANDS_END, open_header, special_format
from jaxsfm.io.images import ImageFile, image_bytes

Tag = ExifTags.Base
CAMERA = (Tag.Make, Tag.Model)
LENS = (
    Tag.FocalLength,
    Tag.FocalLengthIn35mmFilm,
    Tag.FocalPlaneXResolution,
    Tag.FocalPlaneYResolution,
    Tag.FocalPlaneResolutionUnit,
)


@contextlib.contextmanager
def readable_by_colmap(image: ImageFile) -> Iterator[Path]:
    """The file of a photo, or a grey JPEG with its size and its camera's EXIF tags.

    Raises OSError or ImageError if the file has changed or cannot be read.
    """
    with image.path.open("rb") as file:
        if special_format(file.read(BRANDS_END), image.path.suffix) is None:
            yield image.path
            return
    data = image_bytes(image)
    with open_header(data, image.path.suffix) as header:
        exif = _of_camera(header.getexif())
    width, height = image.size
    _, grey = cv2.imencode(".jpg", np.zeros((height, width), np.uint8))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        path = Path(scratch) / "camera.jpg"
        path.write_bytes(_with_exif(grey.tobytes(), exif))
        yield path


def _of_camera(exif: Image.Exif) -> Image.Exif:
    """The tags that say what the camera and its lens are."""
    kept = Image.Exif()
    for tag in CAMERA:
        if tag in exif:
            kept[tag] = exif[tag]
    lens = exif.get_ifd(ExifTags.IFD.Exif)
    kept.get_ifd(ExifTags.IFD.Exif).update({tag: lens[tag] for tag in LENS if tag in lens})
    return kept


def _with_exif(jpeg: bytes, exif: Image.Exif) -> bytes:
    """A JPEG with EXIF data: its segment APP1 follows the start marker (ITU-T T.81, B.1)."""
    content = exif.tobytes()
    return jpeg[:2] + b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content + jpeg[2:]
