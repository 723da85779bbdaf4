"""The headers and pixels of photos in any format, from the bytes of their files.

OpenCV decodes most formats. HEIC, AVIF and camera RAW are read by other packages, which the extra
`formats` installs. This module knows which package reads what, and what EXIF says of the camera;
`jaxsfm.io.images` checks the files and reports what is wrong with them.
"""

import contextlib
import io
import re
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol

import cv2
import numpy as np
from PIL import ExifTags, Image, features

from jaxsfm.errors import UserError

if TYPE_CHECKING:
    import rawpy

Format = Literal["heic", "avif", "raw"]
SUFFIXES: dict[str, Format] = {
    ".heic": "heic",
    ".heif": "heic",
    ".hif": "heic",
    ".avif": "avif",
    ".arw": "raw",
    ".cr2": "raw",
    ".cr3": "raw",
    ".dng": "raw",
    ".nef": "raw",
    ".orf": "raw",
    ".pef": "raw",
    ".raf": "raw",
    ".rw2": "raw",
    ".srw": "raw",
}
"""The suffixes of the formats that OpenCV does not decode."""
RANK: dict[Format | None, int] = {None: 0, "heic": 1, "avif": 1, "raw": 2}
"""Of two files of one photo, that of the lower rank is read. None stands for the formats that
OpenCV decodes."""
_HEIC_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx"}
_AVIF_BRANDS = {b"avif", b"avis"}
BRANDS_END = 512
"""The format of a file is known by so many bytes of its beginning."""
SIDEWAYS = 4
"""The bit of LibRaw's `flip` that says that width and height change places."""
TIFF = (b"II*\0", b"MM\0*")
"""How TIFF files begin."""
_SCAN_END = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
"""The first marker after the entropy-coded data of a JPEG scan."""
_HOW = "pip install 'jaxsfm[formats]'"


class MissingReader(UserError):
    """A format needs a package that is not installed. The message does not name the file."""


class Header(Protocol):
    """What is known of a photo before it is decoded; Pillow's images are such."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pixels that `decoded` gives."""
        ...

    def getexif(self) -> Image.Exif:
        """The EXIF data. Its orientation says how the pixels that `decoded` gives are to be turned;
        HEIC and RAW are turned in decoding, so that nothing is left to turn."""
        ...


class _RawHeader(NamedTuple):
    size: tuple[int, int]
    exif: Image.Exif

    def getexif(self) -> Image.Exif:
        return self.exif


def special_format(data: bytes, suffix: str) -> Format | None:
    """The format of a file that OpenCV cannot decode; None for any other file.

    HEIC and AVIF are known by the content, because their files are often renamed. RAW files are
    known by their suffix, because the content of many looks like a TIFF.
    """
    if data[4:8] == b"ftyp":
        end = min(int.from_bytes(data[:4], "big"), BRANDS_END)
        brands = {data[8:12], *(data[at : at + 4] for at in range(16, end, 4))}
        if brands & _AVIF_BRANDS:
            return "avif"
        if brands & _HEIC_BRANDS:
            return "heic"
    return "raw" if SUFFIXES.get(suffix.lower()) == "raw" else None


def open_header(data: bytes, suffix: str) -> AbstractContextManager[Header]:
    """The header of a photo, from the content and the suffix of its file.

    Raises:
      MissingReader: the package that reads the format is not installed.
      Exception: the file is not a readable photo; Pillow's readers can raise almost anything.
    """
    kind = special_format(data, suffix)
    if kind == "raw":
        return _raw_header(data)
    _prepare(kind)
    return Image.open(io.BytesIO(data))


def decoded(data: bytes, suffix: str, flags: int) -> np.ndarray | None:
    """The pixels of a photo, uint8 (h, w, 3), BGR; None if they cannot be decoded.

    Args:
      flags: those of `cv2.imdecode`, for the formats that OpenCV decodes.

    Raises:
      MissingReader: the package that reads the format is not installed.
      MemoryError: there is not enough memory.
      cv2.error: OpenCV cannot decode it.
    """
    kind = special_format(data, suffix)
    if kind is None:
        with memory_needed():
            return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    try:
        if kind == "raw":
            with _raw(data) as raw:
                rgb = raw.postprocess(use_camera_wb=True, output_bps=8)
        else:
            with any_size(), open_header(data, suffix) as image:
                assert isinstance(image, Image.Image)
                rgb = np.asarray(image.convert("RGB"))
    except (MissingReader, MemoryError):
        raise
    except Exception:  # the readers can raise almost anything
        return None
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)


@contextlib.contextmanager
def memory_needed() -> Iterator[None]:
    """Report OpenCV's lack of memory as Python's, a MemoryError: it says nothing of a photo."""
    try:
        yield
    except cv2.error as error:
        if error.code == cv2.Error.STS_NO_MEM:
            raise MemoryError(error.err) from error
        raise


@contextlib.contextmanager
def any_size() -> Iterator[None]:
    """Let Pillow read an image of any size; `jaxsfm.io.images` has a limit of its own."""
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _prepare(kind: Format | None) -> None:
    """Make Pillow read a format; MissingReader if it cannot."""
    if kind == "avif" and not features.check("avif"):
        raise MissingReader(f"reading AVIF needs a newer Pillow: {_HOW}")
    if kind == "heic":
        try:
            import pillow_heif
        except ImportError as error:
            raise MissingReader(f"reading HEIC needs {_HOW}") from error
        pillow_heif.register_heif_opener()


def _raw(data: bytes) -> "rawpy.RawPy":
    try:
        import rawpy
    except ImportError as error:
        raise MissingReader(f"reading camera RAW needs {_HOW}") from error
    return rawpy.imread(io.BytesIO(data))


@contextlib.contextmanager
def _raw_header(data: bytes) -> Iterator[_RawHeader]:
    with _raw(data) as raw:
        sizes = raw.sizes
        width, height = sizes.iwidth, sizes.iheight
        size = (height, width) if sizes.flip & SIDEWAYS else (width, height)
        yield _RawHeader(size, _raw_exif(data, raw))


def _raw_exif(data: bytes, raw: "rawpy.RawPy") -> Image.Exif:
    """The EXIF data of a RAW file, empty if there is none.

    Most RAW files are TIFF files, and EXIF data are a TIFF file too. The others hold a JPEG.
    """
    exif = Image.Exif()
    with contextlib.suppress(Exception):
        if data[:4] in TIFF:
            exif.load(data)
            exif.get_ifd(ExifTags.IFD.Exif)
        else:
            jpeg = bytes(raw.extract_thumb().data)
            with any_size(), Image.open(io.BytesIO(jpeg)) as preview:
                exif = preview.getexif()
                exif.get_ifd(ExifTags.IFD.Exif)  # read now, while the preview is open
    exif.pop(ExifTags.Base.Orientation, None)
    return exif


def exif_of(header: Header) -> dict[int, object]:
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
