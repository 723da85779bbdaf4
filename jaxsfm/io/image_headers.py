"""What the bytes of a photo's file say of it before it is decoded."""

import re
from collections.abc import Mapping

from PIL import ExifTags

from jaxsfm.io import decoders

_CAMERA = ("Make", "Model", "BodySerialNumber", "LensModel", "FocalLength", "DigitalZoomRatio")
"""The tags that tell cameras apart."""


def exif_of(header: decoders.Header) -> dict[int, object]:
    """The EXIF data of a photo; empty if there is none or it is damaged.

    OpenCV turns a TIFF file upright when it decodes it, and Pillow gives its upright size. So its
    orientation is left out.
    """
    try:
        exif = header.getexif()
        found = {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
    except Exception:  # Pillow's readers can raise almost anything
        return {}
    if getattr(header, "format", None) == "TIFF":
        found.pop(ExifTags.Base.Orientation, None)
    return found


def taken_with(exif: Mapping[int, object]) -> str:
    """What EXIF says of the camera (`ImageFile.taken_with`)."""
    if not exif.get(ExifTags.Base.Model):
        return ""
    values = (exif.get(ExifTags.Base[tag], "") for tag in _CAMERA)
    return ", ".join(text for value in values if (text := str(value).strip("\0 ")))


_SCAN_END = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")


def jpeg_is_complete(data: bytes) -> bool:
    """Whether the end marker follows the last scan; bytes that a camera appends are ignored.

    Source: ITU-T T.81, B.1. Segments carry their length. Entropy-coded data ends at the next marker
    that is neither a stuffed zero nor a restart.
    """
    position = 2
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            return False
        marker = data[position + 1]
        if marker == 0xD9:
            return True
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD8:
            position += 1 if marker == 0xFF else 2
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == 0xDA:
            end = _SCAN_END.search(data, position)
            if end is None:
                return False
            position = end.start()
    return data[position : position + 2] == b"\xff\xd9"
