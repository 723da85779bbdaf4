"""360-degree photos: which photos are panoramas, and their pixels as pinhole views show them.

Source of the XMP fields: Google's Photo Sphere XMP metadata (namespace GPano).
"""

import contextlib
import io
import re
from collections.abc import Iterator

import cv2
import numpy as np
from PIL import ExifTags, Image

from jaxsfm.core.panorama import ViewSet, panorama_pixels, rows_per_pixel
from jaxsfm.io import decoders
from jaxsfm.io.exif_data import exif_data, xmp_data
from jaxsfm.io.images import ImageFile, read_image, reduction

CAMERAS = re.compile(
    r"RICOH THETA|Insta360|GoPro MAX|GoPro, Max|Gear 360|SM-R210|SM-C200|KeyMission 360|LG-R105"
    r"|QooCam|VIRB 360|MiSphere|Pilot Era|Pilot One|TRISIO|Osmo 360",
    re.IGNORECASE,
)
"""Makers and models that write panoramas, as EXIF names them. Some of these cameras take ordinary
photos too, but not with two pixels of width for each of height."""
_PROJECTION = re.compile(rb"GPano:ProjectionType\s*(?:=\s*[\"']|>)\s*equirectangular", re.I)
_FULL, _CROPPED = (
    re.compile(rb"GPano:%s\s*(?:=\s*[\"']|>)\s*(\d{1,9})" % name)
    for name in (b"FullPanoWidthPixels", b"CroppedAreaImageWidthPixels")
)
BAND = 2**18
"""Samples of a view that are interpolated at once; their directions take 20 MB."""


def is_equirectangular_size(size: tuple[int, int]) -> bool:
    """Whether (width, height) is that of a panorama of the whole sphere."""
    return size[0] == 2 * size[1]


def is_panorama(image: ImageFile) -> bool:
    """Whether a photo says that it is a panorama of the whole sphere.

    It is twice as wide as high, and its XMP data say so (GPano), or EXIF names a 360-degree camera.
    The RAW files of such cameras have the same shape, but show two fisheye pictures.
    """
    if not is_equirectangular_size(image.size):
        return False
    raw = decoders.SUFFIXES.get(image.path.suffix.lower()) == "raw"
    if CAMERAS.search(image.taken_with) and not raw:
        return True
    xmp = xmp_data(image)
    if not _PROJECTION.search(xmp):
        return False
    full, cropped = _FULL.search(xmp), _CROPPED.search(xmp)
    return full is None or cropped is None or int(full[1]) == int(cropped[1])


def render_views(rgb: np.ndarray, views: ViewSet, side: int) -> Iterator[np.ndarray]:
    """What the pinhole views of a panorama show, each uint8 (side, side, c), in their order.

    A pixel is the mean of samples that are at least as dense as the panorama's pixels, so nothing
    aliases where the panorama is finer than the view.

    Args:
      rgb: uint8 (h, 2 h, c).

    Raises:
      ValueError: the panorama is not twice as wide as high.
    """
    height, width, channels = rgb.shape
    if not is_equirectangular_size((width, height)):
        raise ValueError(f"rgb must be twice as wide as high; got {width} x {height} pixels")
    samples = max(1, int(np.ceil(width / (2 * np.pi) / views.focal(side))))
    step = max(1, BAND // (side * samples**2))
    for rotation in views.rotations():
        view = np.empty((side, side, channels), np.uint8)
        for top in range(0, side, step):
            band = view[top : top + step]
            rays = views.rays(side, samples=samples, rows=slice(top, top + step))
            shown = _interpolated(rgb, panorama_pixels(rays @ rotation, (width, height)))
            if samples > 1:
                shown = cv2.resize(shown, (side, len(band)), interpolation=cv2.INTER_AREA)
            band[:] = shown.reshape(band.shape)
        yield view


def _interpolated(rgb: np.ndarray, at: np.ndarray) -> np.ndarray:
    """A panorama at pixels (h, w, 2): uint8 (h, w) or (h, w, c)."""
    width, x, y = rgb.shape[1], at[..., 0], at[..., 1]
    if np.ptp(x) > width / 2:  # they lie on both sides of the seam, or round a pole
        x = np.where(x < width / 2, x + width, x)
    left, top = int(np.floor(x.min())), int(np.floor(y.min()))
    right, bottom = int(np.floor(x.max())) + 2, int(np.floor(y.max())) + 2
    window = _window(rgb, slice(top, bottom), slice(left, right))
    x, y = (x - left).astype(np.float32), (y - top).astype(np.float32)
    return cv2.remap(window, x, y, cv2.INTER_LINEAR)


def _window(rgb: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    """A part of a panorama, which goes on round the sphere and, on its other side, over the poles.
    Its rows have no more detail than the equator."""
    height, width = rgb.shape[:2]
    above, below = max(0, -rows.start), max(0, rows.stop - height)
    opposite = slice(columns.start + width // 2, columns.stop + width // 2)
    parts = [
        _columns(_rows(rgb, slice(0, above))[::-1], opposite),
        _columns(_rows(rgb, slice(max(rows.start, 0), rows.stop)), columns),
        _columns(_rows(rgb, slice(height - below, height))[::-1], opposite),
    ]
    return np.concatenate(parts) if above or below else parts[1]


def _columns(rows: np.ndarray, columns: slice) -> np.ndarray:
    """Columns of rows that go round the sphere, and overlap by a few pixels at most."""
    width, start = rows.shape[1], columns.start % rows.shape[1]
    stop = start + columns.stop - columns.start
    if stop <= width:
        return rows[:, start:stop]
    rest = [rows[:, : max(0, stop - turns * width)] for turns in (1, 2)]
    return np.concatenate([rows[:, start:], *rest], axis=1)


def _rows(rgb: np.ndarray, rows: slice) -> np.ndarray:
    """Rows of a panorama uint8 (h, w, c), with no more detail than its equator has.

    A row near a pole has many pixels for the width of one at the equator. A view has one sample for
    all of them, so it is given their mean.
    """
    height, width = rgb.shape[:2]
    halves = np.round((np.minimum(rows_per_pixel(height)[rows], width) - 1) / 2).astype(int)
    if not halves.any():
        return rgb[rows]
    smooth = rgb[rows].copy()
    for row, half in enumerate(halves):
        if half:
            ring = np.pad(smooth[row : row + 1], ((0, 0), (half, half), (0, 0)), mode="wrap")
            means = cv2.blur(ring, (2 * int(half) + 1, 1))[0, half : half + width]
            smooth[row] = means.reshape(smooth[row].shape)
    return smooth


def render_masks(used: np.ndarray, views: ViewSet, side: int) -> Iterator[np.ndarray]:
    """Which pixels of the views are used, each bool (side, side): those that show nothing else.

    Args:
      used: bool (h, 2 h), the used pixels of the panorama.
    """
    shown = render_views(np.multiply(used, 255, dtype=np.uint8)[..., None], views, side)
    return (each[..., 0] == 255 for each in shown)


def without_nadir(size: tuple[int, int], degrees: float) -> np.ndarray:
    """The pixels of a panorama of (width, height) that are more than so many degrees away from
    straight down, bool (h, w): below the camera stands its photographer."""
    width, height = size
    below = 180 * (np.arange(height) + 0.5) / height
    return np.broadcast_to((180 - below > degrees)[:, None], (height, width))


def read_panorama(image: ImageFile) -> tuple[np.ndarray, np.ndarray | None]:
    """The pixels of a panorama, uint8 (h, 2 h, 3), and those that its mask allows, None if all.

    They are fewer than the file has if it has more than can be decoded.

    Raises:
      ImageError: it cannot be decoded.
    """
    found = read_image(image, max_size=2 * (image.size[1] // reduction(image)))
    return found.rgb, None if image.mask is None else found.used


def gps_as_exif(image: ImageFile) -> bytes:
    """EXIF data for the views of a panorama: its GPS position, if it has one, and nothing else.

    Raises:
      ImageError: the panorama's file is gone or has changed.
    """
    gps, exif = exif_data(image).gps, Image.Exif()
    with contextlib.suppress(Exception):  # fields that cannot be written are not worth a failure
        if gps:
            exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
        return exif.tobytes()
    return Image.Exif().tobytes()


def view_as_jpeg(rgb: np.ndarray, exif: bytes, quality: int) -> bytes:
    """A view as JPEG."""
    out = io.BytesIO()
    Image.fromarray(rgb).save(out, "JPEG", quality=quality, subsampling=0, exif=exif)
    return out.getvalue()
