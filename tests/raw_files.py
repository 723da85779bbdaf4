"""A camera RAW file in Adobe's DNG format, with as few tags as LibRaw needs."""

import struct

import numpy as np

SHORT, LONG, RATIONAL, SRATIONAL, BYTE, ASCII = 3, 4, 5, 10, 1, 2
WIDTHS = {SHORT: "H", LONG: "I", BYTE: "B"}


def _packed(kind: int, values) -> tuple[int, bytes]:
    if kind == ASCII:
        text = values.encode() + b"\0"
        return len(text), text
    if kind in (RATIONAL, SRATIONAL):
        parts = [(round(v * 10000), 10000) for v in values]
        letter = "I" if kind == RATIONAL else "i"
        return len(parts), b"".join(struct.pack(f"<2{letter}", *p) for p in parts)
    return len(values), struct.pack(f"<{len(values)}{WIDTHS[kind]}", *values)


def _directory(entries: dict, at: int) -> bytes:
    """A TIFF directory at an offset, with its larger values after it."""
    rows, values = b"", b""
    behind = at + 2 + 12 * len(entries) + 4
    for tag, (kind, given) in sorted(entries.items()):
        count, data = _packed(kind, given)
        if len(data) <= 4:
            field = data.ljust(4, b"\0")
        else:
            field = struct.pack("<I", behind + len(values))
            values += data + b"\0" * (len(data) % 2)
        rows += struct.pack("<HHI", tag, kind, count) + field
    return struct.pack("<H", len(entries)) + rows + struct.pack("<I", 0) + values


def dng(rgb: np.ndarray, *, orientation: int = 1, focal35: int = 28) -> bytes:
    """A DNG file whose sensor saw an image, uint8 (h, w, 3), behind red, green and blue filters.

    Args:
      orientation: the value of the EXIF tag.
      focal35: the focal length in EXIF, millimetres on 35 mm film.
    """
    height, width = rgb.shape[:2]
    linear = ((rgb / 255.0) ** 2.2 * 16000).astype("<u2")
    mosaic = linear[..., 1].copy()
    mosaic[0::2, 0::2] = linear[0::2, 0::2, 0]
    mosaic[1::2, 1::2] = linear[1::2, 1::2, 2]
    exif = {0x920A: (RATIONAL, [4.2]), 0xA405: (SHORT, [focal35])}

    def entries(exif_at: int, pixels_at: int) -> dict:
        return {
            254: (LONG, [0]),
            256: (LONG, [width]),
            257: (LONG, [height]),
            258: (SHORT, [16]),
            259: (SHORT, [1]),
            262: (SHORT, [32803]),  # a colour filter array
            271: (ASCII, "Maker"),
            272: (ASCII, "Model"),
            273: (LONG, [pixels_at]),
            274: (SHORT, [orientation]),
            277: (SHORT, [1]),
            278: (LONG, [height]),
            279: (LONG, [mosaic.nbytes]),
            33421: (SHORT, [2, 2]),
            33422: (BYTE, [0, 1, 1, 2]),
            34665: (LONG, [exif_at]),
            50706: (BYTE, [1, 4, 0, 0]),  # DNG version
            50708: (ASCII, "Maker Model"),
            50717: (LONG, [16000]),  # white
            50721: (SRATIONAL, [3.24, -1.54, -0.5, -0.97, 1.88, 0.04, 0.06, -0.2, 1.06]),
            50728: (RATIONAL, [1.0, 1.0, 1.0]),  # the neutral colour
            50778: (SHORT, [21]),  # daylight
        }

    first = len(_directory(entries(0, 0), 8))
    exif_at = 8 + first
    second = _directory(exif, exif_at)
    pixels_at = exif_at + len(second)
    head = b"II*\0" + struct.pack("<I", 8)
    return head + _directory(entries(exif_at, pixels_at), 8) + second + mosaic.tobytes()
