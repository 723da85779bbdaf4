"""360-degree photos: which photos are panoramas, and their pixels as pinhole views show them.

Source of the XMP fields: Google's Photo Sphere XMP metadata (namespace GPano).
"""

import contextlib
import io
import re
import warnings
from collections.abc import Iterator

import cv2
import numpy as np
from PIL import Image

from jaxsfm.core.panorama import ViewSet, panorama_pixels, rows_per_pixel
from jaxsfm.io import decoders
from jaxsfm.io.images import ImageFile, image_bytes, read_image

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
MARGIN = 2
"""Pixels that are appended to each side of a panorama, so that interpolation needs no border."""


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
    xmp = _xmp_of(image)
    if not _PROJECTION.search(xmp):
        return False
    full, cropped = _FULL.search(xmp), _CROPPED.search(xmp)
    return full is None or cropped is None or int(full[1]) == int(cropped[1])


def _xmp_of(image: ImageFile) -> bytes:
    """The XMP data of a photo; empty if there are none. ImageError if the file has changed."""
    data = image_bytes(image)
    with warnings.catch_warnings(), contextlib.suppress(Exception):  # see `inspect_image`
        warnings.simplefilter("ignore")
        with decoders.any_size(), decoders.open_header(data, image.path.suffix) as header:
            info = getattr(header, "info", {})
            found = info.get("xmp") or info.get("XML:com.adobe.xmp") or b""
            return found.encode() if isinstance(found, str) else bytes(found)
    return b""


def without_poles_detail(rgb: np.ndarray) -> np.ndarray:
    """A panorama uint8 (h, w, c) whose rows have no more detail than its equator.

    A row near a pole has many pixels for the width of one at the equator. A view has one sample for
    all of them, so it is given their mean.
    """
    smooth = rgb.copy()
    height, width = rgb.shape[:2]
    for row, pixels in enumerate(rows_per_pixel(height)):
        odd = 2 * round((min(pixels, width) - 1) / 2) + 1
        if odd > 1:
            half = odd // 2
            ring = np.pad(rgb[row : row + 1], ((0, 0), (half, half), (0, 0)), mode="wrap")
            smooth[row] = cv2.blur(ring, (odd, 1))[0, half : half + width].reshape(
                smooth[row].shape
            )
    return smooth


def _with_margin(rgb: np.ndarray) -> np.ndarray:
    """A panorama with `MARGIN` more pixels on each side: round the sphere, and over the poles."""
    over = np.roll(rgb, rgb.shape[1] // 2, axis=1)
    top, bottom = over[:MARGIN][::-1], over[-MARGIN:][::-1]
    whole = np.concatenate([top, rgb, bottom])
    return np.pad(whole, ((0, 0), (MARGIN, MARGIN), (0, 0)), mode="wrap")


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
    source = _with_margin(without_poles_detail(rgb))
    rays = views.rays(side, samples=samples)
    for rotation in views.rotations():
        at = (panorama_pixels(rays @ rotation, (width, height)) + MARGIN).astype(np.float32)
        view = cv2.remap(source, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        if samples > 1:
            view = cv2.resize(view, (side, side), interpolation=cv2.INTER_AREA)
        yield view.reshape(side, side, channels)


def render_masks(used: np.ndarray, views: ViewSet, side: int) -> Iterator[np.ndarray]:
    """Which pixels of the views are used, each bool (side, side): those that show nothing else.

    Args:
      used: bool (h, 2 h), the used pixels of the panorama.
    """
    shown = render_views(255 * used.astype(np.uint8)[..., None], views, side)
    return (each[..., 0] == 255 for each in shown)


def without_nadir(size: tuple[int, int], degrees: float) -> np.ndarray:
    """The pixels of a panorama of (width, height) that are more than so many degrees away from
    straight down, bool (h, w): below the camera stands its photographer."""
    width, height = size
    below = 180 * (np.arange(height) + 0.5) / height
    return np.repeat((180 - below > degrees)[:, None], width, axis=1)


def read_panorama(image: ImageFile) -> tuple[np.ndarray, np.ndarray | None]:
    """The pixels of a panorama, uint8 (h, w, 3), and those that its mask allows, None if all.

    Raises:
      ImageError: it cannot be decoded.
    """
    found = read_image(image, max_size=max(image.size))
    return found.rgb, None if image.mask is None else found.used


def jpeg_with_gps(rgb: np.ndarray, image: ImageFile, quality: int) -> bytes:
    """A view as JPEG, with the GPS position of its panorama, if it has one.

    Raises:
      ImageError: the panorama's file is gone or has changed.
    """
    exif = Image.Exif()
    with contextlib.suppress(Exception):  # odd metadata are not worth a failure
        data = image_bytes(image)
        with decoders.any_size(), decoders.open_header(data, image.path.suffix) as header:
            gps = header.getexif().get_ifd(0x8825)
            if gps:
                exif.get_ifd(0x8825).update(gps)
                exif.tobytes()
    out = io.BytesIO()
    Image.fromarray(rgb).save(out, "JPEG", quality=quality, subsampling=0, exif=exif)
    return out.getvalue()
