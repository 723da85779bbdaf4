"""Damaged image files: pixels, or one sentence that names the file."""

import io
import struct
import zlib

import cv2
import numpy as np
import pillow_heif
from fuzz_children import run_cases
from mutations import damaged, outcome
from PIL import Image
from raw_files import dng

from jaxsfm.config import MIN_SIDE
from jaxsfm.io.images import inspect_image, read_image

FORMATS = ("jpg", "png", "tif", "bmp", "webp", "ppm", "pgm", "jp2")


SPECIAL = ("heic", "avif", "dng")
"""The formats that OpenCV does not decode."""


def whole(suffix: str) -> bytes:
    """A small photo-like image in a format."""
    ramp = np.add.outer(np.arange(80), 2 * np.arange(96))[..., None] * [1, 0.5, 0.25]
    pixels = (ramp % 256).astype(np.uint8)
    if suffix == "dng":
        return dng(pixels)
    if suffix in SPECIAL:
        pillow_heif.register_heif_opener()
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, {"heic": "HEIF"}.get(suffix, suffix))
        return file.getvalue()
    return cv2.imencode(f".{suffix}", pixels[..., 0] if suffix == "pgm" else pixels)[1].tobytes()


def image(rng, folder) -> str:
    return one_of(FORMATS, rng, folder)


def special(rng, folder) -> str:
    return one_of(SPECIAL, rng, folder)


def one_of(formats, rng, folder) -> str:
    suffix = formats[rng.integers(len(formats))]
    path = folder / f"photo.{suffix}"
    path.write_bytes(damaged(whole(suffix), rng))

    def read():
        found = inspect_image(path)
        return found, read_image(found, max_size=64, enlarge=1.0)

    how, result = outcome(read, path.name)
    if how == "read":
        file, working = result
        height, width = working.rgb.shape[:2]
        assert working.rgb.dtype == np.uint8 and MIN_SIDE <= min(height, width) <= 64
        assert working.scale == (file.size[0] / width, file.size[1] / height)
    return how


def png(width: int, height: int) -> bytes:
    """Its header is right; the pixels are a few zeros."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        sum_ = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", sum_)

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(10_000)))
    return b"\x89PNG\r\n\x1a\n" + body + chunk(b"IEND", b"")


def absurd_size(rng, folder) -> str:
    """A header of any size up to the format's largest."""
    size = [int(2 ** rng.uniform(6, 31)) for _ in range(2)] if rng.random() < 0.9 else [100_000] * 2
    path = folder / "absurd.png"
    path.write_bytes(png(*size))
    return outcome(lambda: read_image(inspect_image(path), max_size=64), path.name)[0]


def test_a_damaged_image_is_read_or_refused_by_name(tmp_path, share, least):
    found = run_cases("test_fuzz_images", "image", round(600 * share), tmp_path)
    assert found["read"] > 100 * least and found["refused"] > 100 * least


def test_a_damaged_heic_avif_or_raw_is_read_or_refused_by_name(tmp_path, share, least):
    found = run_cases("test_fuzz_images", "special", round(300 * share), tmp_path)
    assert found["read"] > 30 * least and found["refused"] > 50 * least


def test_what_a_header_claims_is_not_allocated(tmp_path, share, least):
    found = run_cases("test_fuzz_images", "absurd_size", round(60 * share), tmp_path)
    assert found["refused"] > 30 * least
