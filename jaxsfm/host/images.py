"""Finding and reading images: one function for everything that looks at pixels.

EXIF orientation is ignored, because COLMAP 4.2 ignores it (measured): the pixels lie as they are
stored, so keypoints, intrinsics and COLMAP's own tools agree.
"""

import dataclasses
import hashlib
import logging
import warnings
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

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
    if not folder.exists():
        raise UserError(f"{folder}: no such folder")
    if not folder.is_dir():
        raise UserError(f"{folder}: not a folder")
    names = [
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.suffix.lower() in SUFFIXES
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
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
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{shown}: cannot be read ({error.strerror})") from error
    if not data:
        raise ImageError(f"{shown}: the file is empty")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # size warnings: we set our own limit
            with Image.open(path) as header:
                size = header.size
    except Image.DecompressionBombError as error:
        raise ImageError(f"{shown}: too large to read ({error})") from error
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
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
    return name.encode("unicode_escape").decode() if not name.isprintable() else name


def _check_complete(data: bytes, shown: str) -> None:
    """A JPEG must end after its last scan: decoders fill what is missing with grey, silently."""
    if data[:2] == b"\xff\xd8" and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        raise ImageError(f"{shown}: the file is truncated")


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
        data = np.frombuffer(image.path.read_bytes(), np.uint8)
        bgr = cv2.imdecode(data, flags)
    except OSError as error:
        raise ImageError(f"{shown}: cannot be read ({error.strerror})") from error
    except (cv2.error, MemoryError) as error:
        raise ImageError(f"{shown}: cannot be decoded") from error
    if bgr is None:
        raise ImageError(f"{shown}: damaged, or a format that cannot be decoded")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def working_size(size: tuple[int, int], max_size: int) -> tuple[int, int]:
    """(width, height) with the longer side at most `max_size`; never enlarged, at least 1."""
    longer = max(size)
    if longer <= max_size:
        return size
    width, height = (max(1, round(side * max_size / longer)) for side in size)
    return width, height


def read_image(image: ImageFile, *, max_size: int) -> WorkingImage:
    """Decode and reduce; grey, alpha, 16-bit and CMYK become 8-bit RGB.

    Raises:
      ImageError: the file cannot be decoded, or its reduced size is too narrow.
    """
    rgb = _decode(image)
    width, height = working_size(image.size, max_size)
    if min(width, height) < MIN_SIDE:
        raise ImageError(
            f"{shown_name(image.name)}: {width} x {height} pixels after reduction to "
            f"{max_size} is too narrow (at least {MIN_SIDE} per side)"
        )
    if rgb.shape[:2] != (height, width):
        rgb = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
    return WorkingImage(
        rgb=np.ascontiguousarray(rgb), scale=(image.size[0] / width, image.size[1] / height)
    )
