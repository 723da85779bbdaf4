"""Finding and reading images. All code that looks at the pixels of a photo reads it here.

Pixels are read as they are stored, unless the reader asks for an upright photo. All coordinates
that are written are those of the stored pixels. COLMAP 4.2 does the same (measured), so keypoints
and intrinsics agree with COLMAP's own tools.
"""

import dataclasses
import hashlib
import logging
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import ExifTags

from jaxsfm.config import MIN_SIDE
from jaxsfm.errors import UserError
from jaxsfm.io import decoders, orientation
from jaxsfm.io.exif_camera import taken_with
from jaxsfm.io.image_names import name_fault
from jaxsfm.io.masks import MaskFile, read_mask, without_blank_border

logger = logging.getLogger(__name__)

MAX_DECODED_PIXELS = 250_000_000
"""Larger images (0.75 GB) are refused, or decoded at reduced size if their format allows it."""
_ROWS = 256
"""Rows of an image whose colours are reordered at once."""
MOST_NAMED = 3
"""The number of photos that a message names of a list."""
_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_REDUCED = {n: getattr(cv2, f"IMREAD_REDUCED_COLOR_{n}") for n in (2, 4, 8)}
# Damage is reported by jaxsfm. OpenCV 4.10 has the function in another place than 5.
vars(getattr(cv2.utils, "logging", cv2))["setLogLevel"](0)


class ImageError(UserError):
    """One image cannot be used. A run reports it and goes on with the others."""


class DamagedImage(ImageError):
    """The content of an image cannot be decoded, so trying again will not help."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImageFile:
    """An image file that has been checked (`inspect_image`)."""

    name: str
    """The path below the image folder, with '/'. COLMAP and the reports use this name."""
    path: Path
    size: tuple[int, int]
    """(width, height) as stored, pixels."""
    sha256: str
    """The SHA-256 of the file's bytes, hexadecimal."""
    orientation: int = orientation.UPRIGHT
    """How the stored photo is turned to be upright (`jaxsfm.io.orientation`)."""
    taken_with: str = ""
    """The camera, its lens and its focal length, as EXIF names them; empty if EXIF names no camera.
    Photos of one zoom lens differ in the focal length."""
    mask: MaskFile | None = None
    """Says which pixels are used; None: all but a blank border."""

    @property
    def content(self) -> str:
        """What the features of the photo depend on: its bytes, how it is turned, and its mask."""
        return content(self.sha256, self.orientation, self.mask and self.mask.sha256)

    @property
    def upright_size(self) -> tuple[int, int]:
        """(width, height) of the photo when it is upright, pixels."""
        return orientation.upright_size(self.size, self.orientation)

    @property
    def identity(self) -> int:
        """32 bits of the hash. They are the image's part in the random key of a pair."""
        return int(self.sha256[:8], 16)


def orientations(images: Iterable[ImageFile]) -> dict[str, int]:
    """How the images that are not stored upright are turned, by name."""
    upright = orientation.UPRIGHT
    return {i.name: i.orientation for i in images if i.orientation != upright}


def content(sha256: str, turned: int, mask: str | None) -> str:
    """What describes the used pixels of an upright photo.

    Args:
      sha256: of the photo's file.
      turned: its orientation.
      mask: the SHA-256 of the mask's file; None: no mask.
    """
    parts = [sha256]
    if turned != orientation.UPRIGHT:
        parts.append(f"turned {turned}")
    if mask is not None:
        parts.append(f"masked by {mask}")
    return " ".join(parts)


class WorkingImage(NamedTuple):
    """The pixels of an image at working size."""

    rgb: np.ndarray
    """uint8 (height, width, 3)."""
    scale: tuple[float, float]
    """Original pixels per working pixel, (x, y); of an upright photo, in pixels of the upright
    original."""
    used: np.ndarray | None = None
    """bool (height, width): the pixels that are used; None: all."""


def inspect_image(path: Path, *, name: str | None = None) -> ImageFile:
    """Check an image file and find its size and hash, without decoding it.

    Args:
      name: the image's name; None takes the name of the file.

    Raises:
      ImageError: the file is unreadable, empty, truncated or not an image, or the image is too
        small for one matching window.
    """
    shown = shown_name(name or str(path))
    if (fault := name_fault(name or path.name)) is not None:
        raise ImageError(f"{shown}: {fault}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{shown}: cannot be read ({error.strerror})") from error
    except ValueError as error:  # the name contains what no path can
        raise ImageError(f"{shown}: no file can have this name") from error
    if not data:
        raise ImageError(f"{shown}: the file is empty")
    try:
        with warnings.catch_warnings(), decoders.any_size():
            warnings.simplefilter("ignore")  # about odd metadata; only the size is needed
            # Pillow is not given the path: reading from a file, it allocates what the header says.
            with decoders.open_header(data, path.suffix) as header:
                size, exif = header.size, decoders.exif_of(header)
    except decoders.MissingReader as error:
        raise ImageError(f"{shown}: {error}") from error
    except Exception as error:  # Pillow's readers can raise almost anything
        raise ImageError(f"{shown}: not a readable image") from error
    if min(size) < MIN_SIDE:
        raise ImageError(
            f"{shown}: {size[0]} x {size[1]} pixels is too small (at least {MIN_SIDE} per side)"
        )
    # Decoders would fill the missing part of a JPEG with grey and not say so.
    if data[:2] == b"\xff\xd8" and not decoders.jpeg_is_complete(data):
        raise ImageError(f"{shown}: the file is truncated")
    digest = hashlib.sha256(data).hexdigest()
    return ImageFile(
        name=name or path.name,
        path=path,
        size=size,
        sha256=digest,
        orientation=orientation.checked(exif.get(ExifTags.Base.Orientation)),
        taken_with=taken_with(exif),
    )


def shown_name(name: str) -> str:
    """Return a file name for messages: line breaks and the like are replaced by escapes."""
    return name if name.isprintable() else name.encode("unicode_escape").decode()


def named(names: Sequence[str]) -> str:
    """The first names of a list for messages, and how many more there are."""
    shown = ", ".join(shown_name(name) for name in names[:MOST_NAMED])
    return f"{shown} and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else shown


def image_bytes(image: ImageFile) -> bytes:
    """Read the bytes of an image file, which must be those that were inspected.

    Results are stored under the hash of the file, so they must not be made from other bytes. Raises
    ImageError if the file cannot be read or has changed.
    """
    try:
        data = image.path.read_bytes()
    except OSError as error:
        raise ImageError(f"{shown_name(image.name)}: cannot be read ({error.strerror})") from error
    if hashlib.sha256(data).hexdigest() != image.sha256:
        raise ImageError(f"{shown_name(image.name)}: the file has changed since it was first read")
    return data


def reduction(image: ImageFile) -> int:
    """By how much an image is reduced when it is decoded: 1, or 2, 4 or 8 if it is too large.

    Raises:
      ImageError: it is too large, and its format cannot be decoded at reduced size.
    """
    width, height = image.size
    factors = [f for f in (1, *_REDUCED) if width * height <= MAX_DECODED_PIXELS * f * f]
    is_jpeg = image.path.suffix.lower() in (".jpg", ".jpeg", ".jpe")
    if not factors or (factors[0] > 1 and not is_jpeg):
        raise ImageError(
            f"{shown_name(image.name)}: {width} x {height} pixels is more than can be decoded "
            f"({MAX_DECODED_PIXELS} pixels); reduce it first"
        )
    return factors[0]


def _decode(image: ImageFile) -> np.ndarray:
    shown = shown_name(image.name)
    flags = _FLAGS
    if (factor := reduction(image)) > 1:
        width, height = image.size
        logger.warning(
            "%s: has %d x %d pixels, so it is decoded at 1/%d", shown, width, height, factor
        )
        flags = _REDUCED[factor] | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = decoders.decoded(image_bytes(image), image.path.suffix, flags)
    except decoders.MissingReader as error:
        raise ImageError(f"{shown}: {error}") from error
    except cv2.error as error:
        raise DamagedImage(f"{shown}: cannot be decoded") from error
    if bgr is None:
        raise DamagedImage(f"{shown}: the file is damaged, or its format cannot be decoded")
    for top in range(0, len(bgr), _ROWS):  # in its place: a second array would be as large
        bgr[top : top + _ROWS] = cv2.cvtColor(bgr[top : top + _ROWS], cv2.COLOR_BGR2RGB)
    return bgr


def working_size(size: tuple[int, int], max_size: int, enlarge: float = 1.0) -> tuple[int, int]:
    """Return (width, height) of the working image, each at least 1 pixel.

    Args:
      size: (width, height) of the original image.
      max_size: the longer side is reduced, or enlarged, to this many pixels.
      enlarge: the largest factor; with 1, images are never enlarged.
    """
    factor = min(max_size / max(size), enlarge)
    width, height = (max(1, round(side * factor)) for side in size)
    return width, height


def size_and_scale(
    size: tuple[int, int], max_size: int, enlarge: float = 1.0
) -> tuple[tuple[int, int], tuple[float, float]]:
    """`working_size`, and original pixels per working pixel, (x, y)."""
    width, height = working_size(size, max_size, enlarge)
    return (width, height), (size[0] / width, size[1] / height)


def read_image(
    image: ImageFile, *, max_size: int, enlarge: float = 1.0, upright: bool = False
) -> WorkingImage:
    """Decode an image and resize it to its working size (`working_size`).

    Args:
      upright: turn the image so that it is upright, before it is resized.

    Images in grey, with alpha, with 16 bits or in CMYK are converted to RGB with 8 bits. Raises
    ImageError if the file cannot be decoded, or a side would be shorter than `MIN_SIDE`.
    """
    try:
        with decoders.memory_needed():
            return _read(image, max_size=max_size, enlarge=enlarge, upright=upright)
    except MemoryError as error:
        shown = shown_name(image.name)
        raise ImageError(f"{shown}: there is not enough memory to decode it") from error


def _read(image: ImageFile, *, max_size: int, enlarge: float, upright: bool) -> WorkingImage:
    rgb, size = _decode(image), image.size
    used = _mask_of(image)
    if upright:
        rgb, size = orientation.upright(rgb, image.orientation), image.upright_size
        used = None if used is None else orientation.upright(used, image.orientation)
    width, height = working_size(size, max_size, enlarge)
    if min(width, height) < MIN_SIDE:
        raise ImageError(
            f"{shown_name(image.name)}: {width} x {height} pixels after reduction to "
            f"{max_size} is too narrow (at least {MIN_SIDE} per side)"
        )
    if rgb.shape[:2] != (height, width):
        larger = width > size[0]
        how = cv2.INTER_CUBIC if larger else cv2.INTER_AREA
        rgb = cv2.resize(rgb, (width, height), interpolation=how)
    return WorkingImage(
        rgb=np.ascontiguousarray(rgb),
        scale=(size[0] / width, size[1] / height),
        used=_used(rgb, used),
    )


def _mask_of(image: ImageFile) -> np.ndarray | None:
    try:
        return None if image.mask is None else read_mask(image.mask)
    except UserError as error:
        raise ImageError(f"{shown_name(image.name)}: {error}") from error


def _used(rgb: np.ndarray, mask: np.ndarray | None) -> np.ndarray | None:
    """The used pixels of a working image.

    Args:
      mask: bool, the used pixels of the original. A working pixel is used if all of its part is.
    """
    inside = without_blank_border(rgb)
    if mask is None:
        return inside
    height, width = rgb.shape[:2]
    whole = mask
    if mask.shape != (height, width):
        share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        whole = share > 0.999
    return whole if inside is None else whole & inside
