"""Finding and reading images: one function for everything that looks at pixels.

EXIF orientation is ignored, because COLMAP 4.2 ignores it (measured): the pixels lie as they are
stored, so keypoints, intrinsics and COLMAP's own tools agree.
"""

import contextlib
import dataclasses
import hashlib
import io
import logging
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from jaxsfm.config import MIN_SIDE
from jaxsfm.errors import UserError

logger = logging.getLogger(__name__)

SUFFIXES = frozenset(".jpg .jpeg .jpe .png .tif .tiff .bmp .webp .ppm .pgm .jp2".split())
MAX_DECODED_PIXELS = 250_000_000
"""Decoding more than this (0.75 GB) is refused, or done at reduced size where the format can."""
_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_REDUCED = {
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # we report damage ourselves


class ImageError(UserError):
    """One image cannot be used; a run reports it and goes on with the others."""


class DamagedImage(ImageError):
    """Its very content cannot be decoded: trying again will not help."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImageFile:
    """An image on disk, checked."""

    name: str
    """Path below the image folder, with '/'; what COLMAP and the reports call it."""
    path: Path
    size: tuple[int, int]
    """(width, height) as stored, pixels."""
    sha256: str
    """Of the file's bytes."""

    @property
    def identity(self) -> int:
        """32 bits of the content: the image's part in a pair's random key."""
        return int(self.sha256[:8], 16)


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorkingImage:
    """Pixels at working size."""

    rgb: np.ndarray
    """uint8 (height, width, 3)."""
    scale: tuple[float, float]
    """Original pixels per working pixel, (x, y)."""


def find_images(folder: Path) -> list[str]:
    """Names of the image files below a folder, sorted; sub-folders included, hidden ones not."""
    try:
        if not folder.exists():
            raise UserError(f"{folder}: no such folder")
        if not folder.is_dir():
            raise UserError(f"{folder}: not a folder")
        os.listdir(folder)
    except OSError as error:
        raise UserError(f"{folder}: cannot be read ({error.strerror})") from error

    def unreadable(error: OSError) -> None:
        logger.warning("%s: skipped, cannot be read (%s)", error.filename, error.strerror)

    names = []
    for root, folders, files in os.walk(folder, onerror=unreadable):
        folders[:] = [name for name in folders if not name.startswith(".")]
        names += [
            (Path(root) / name).relative_to(folder).as_posix()
            for name in files
            if Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")
        ]
    if not names:
        raise UserError(f"{folder}: no images here (looked for {', '.join(sorted(SUFFIXES))})")
    return sorted(names)


def inspect_image(path: Path, *, name: str | None = None) -> ImageFile:
    """Size and identity of an image without decoding it.

    Raises:
      ImageError: unreadable, empty, not an image, or too small for one matching window.
    """
    shown = shown_name(name or str(path))
    try:
        (name or path.name).encode("utf-8")
    except UnicodeEncodeError as error:
        raise ImageError(f"{shown}: the file name is not UTF-8, which COLMAP needs") from error
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{shown}: cannot be read ({error.strerror})") from error
    except ValueError as error:  # no path can hold such a name
        raise ImageError(f"{shown}: not a file's name") from error
    if not data:
        raise ImageError(f"{shown}: the file is empty")
    try:
        with warnings.catch_warnings(), _any_size():
            warnings.simplefilter("ignore")  # odd metadata; only the size is wanted
            # Not the path: reading from a file allocates what the header asks for.
            with Image.open(io.BytesIO(data)) as header:
                size = header.size
    except Exception as error:  # its readers of fifty formats raise nearly anything
        raise ImageError(f"{shown}: not a readable image") from error
    if min(size) < MIN_SIDE:
        raise ImageError(
            f"{shown}: {size[0]} x {size[1]} pixels is too small (at least {MIN_SIDE} per side)"
        )
    _check_complete(data, shown)
    digest = hashlib.sha256(data).hexdigest()
    return ImageFile(name=name or path.name, path=path, size=size, sha256=digest)


def shown_name(name: str) -> str:
    """A file name that stays on one line in messages."""
    return name if name.isprintable() else name.encode("unicode_escape").decode()


_SCAN_END = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")


def _jpeg_is_complete(data: bytes) -> bool:
    """Whether the end marker follows the last scan; what a camera appends after it is ignored.

    Source: ITU-T T.81, B.1: segments carry their length, entropy-coded data end at the next marker
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


def _check_complete(data: bytes, shown: str) -> None:
    """Decoders fill what is missing of a JPEG with grey, silently: refuse it here."""
    if data[:2] == b"\xff\xd8" and not _jpeg_is_complete(data):
        raise ImageError(f"{shown}: the file is truncated")


@contextlib.contextmanager
def _any_size() -> Iterator[None]:
    """Let Pillow read the header of any image: we set our own limit on decoding."""
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def image_bytes(image: ImageFile) -> bytes:
    """The file as it was when it was inspected: what is made of it is kept under that content.

    Raises:
      ImageError: it cannot be read, or has been changed since.
    """
    try:
        data = image.path.read_bytes()
    except OSError as error:
        raise ImageError(f"{shown_name(image.name)}: cannot be read ({error.strerror})") from error
    if hashlib.sha256(data).hexdigest() != image.sha256:
        raise ImageError(f"{shown_name(image.name)}: the file was changed meanwhile")
    return data


def _decode(image: ImageFile) -> np.ndarray:
    shown = shown_name(image.name)
    width, height = image.size
    flags = _FLAGS
    if width * height > MAX_DECODED_PIXELS:
        is_jpeg = image.path.suffix.lower() in (".jpg", ".jpeg", ".jpe")
        factors = [f for f in _REDUCED if width * height <= MAX_DECODED_PIXELS * f * f]
        if not is_jpeg or not factors:
            raise ImageError(
                f"{shown}: {width} x {height} pixels is more than can be decoded "
                f"({MAX_DECODED_PIXELS} pixels); reduce it first"
            )
        logger.warning("%s: %d x %d pixels, decoded at 1/%d", shown, width, height, factors[0])
        flags = _REDUCED[factors[0]] | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = cv2.imdecode(np.frombuffer(image_bytes(image), np.uint8), flags)
    except MemoryError as error:
        raise ImageError(f"{shown}: there is not enough memory to decode it") from error
    except cv2.error as error:
        raise DamagedImage(f"{shown}: cannot be decoded") from error
    if bgr is None:
        raise DamagedImage(f"{shown}: damaged, or a format that cannot be decoded")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def working_size(size: tuple[int, int], max_size: int, enlarge: float = 1.0) -> tuple[int, int]:
    """(width, height) with the longer side at most `max_size`, at least 1.

    Args:
      enlarge: largest factor; 1: images are reduced only.
    """
    factor = min(max_size / max(size), enlarge)
    width, height = (max(1, round(side * factor)) for side in size)
    return width, height


def read_image(image: ImageFile, *, max_size: int, enlarge: float = 1.0) -> WorkingImage:
    """Decode and resize; grey, alpha, 16-bit and CMYK become 8-bit RGB.

    Raises:
      ImageError: the file cannot be decoded, or its reduced size is too narrow.
    """
    rgb = _decode(image)
    width, height = working_size(image.size, max_size, enlarge)
    if min(width, height) < MIN_SIDE:
        raise ImageError(
            f"{shown_name(image.name)}: {width} x {height} pixels after reduction to "
            f"{max_size} is too narrow (at least {MIN_SIDE} per side)"
        )
    if rgb.shape[:2] != (height, width):
        larger = width > image.size[0]
        how = cv2.INTER_CUBIC if larger else cv2.INTER_AREA
        rgb = cv2.resize(rgb, (width, height), interpolation=how)
    return WorkingImage(
        rgb=np.ascontiguousarray(rgb), scale=(image.size[0] / width, image.size[1] / height)
    )
