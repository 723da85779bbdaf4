"""Decoding and reducing images. PNGs are written by cv2 only (see jaxsfm.colmap)."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from jaxsfm.io import images
from jaxsfm.io.images import DamagedImage, ImageError, inspect_image, read_image

LEFT, RIGHT = (200, 30, 60), (20, 160, 240)


def two_colours(height: int = 64, width: int = 96) -> np.ndarray:
    rgb = np.empty((height, width, 3), np.uint8)
    rgb[:, : width // 2], rgb[:, width // 2 :] = LEFT, RIGHT
    return rgb


def write_png(path: Path, rgb: np.ndarray) -> Path:
    """Write an image that is grey, RGB or RGBA, with 8 or 16 bits."""
    if rgb.ndim == 3:
        code = cv2.COLOR_RGB2BGR if rgb.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        rgb = cv2.cvtColor(rgb, code)
    assert cv2.imwrite(str(path), rgb)
    return path


def jpeg(path: Path, rgb: np.ndarray, **options) -> Path:
    Image.fromarray(rgb).save(path, "JPEG", quality=95, **options)
    return path


def test_exif_orientation_is_ignored_as_colmap_ignores_it(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # rotated by 90 degrees
    image = inspect_image(jpeg(tmp_path / "a.jpg", two_colours(), exif=exif))
    camera = pycolmap.infer_camera_from_image(image.path)
    rgb = read_image(image, max_size=1600).rgb
    assert image.size == (camera.width, camera.height) == (96, 64) == rgb.shape[1::-1]
    assert np.abs(rgb[32, [10, 80]].astype(int) - [LEFT, RIGHT]).max() <= 3


def write_cmyk(path: Path, rgb: np.ndarray) -> Path:
    Image.fromarray(rgb).convert("CMYK").save(path, "JPEG", quality=95)
    return path


FORMATS = {
    "rgb.png": write_png,
    "grey.png": lambda path, rgb: write_png(path, rgb[..., 0]),
    "rgba.png": lambda path, rgb: write_png(
        path, np.dstack([rgb, np.full(rgb.shape[:2], 5, np.uint8)])
    ),
    "grey16.png": lambda path, rgb: write_png(path, rgb[..., 0].astype(np.uint16) * 257),
    "rgb16.png": lambda path, rgb: write_png(path, rgb.astype(np.uint16) * 257),
    "rgb16.tif": lambda path, rgb: write_png(path, rgb.astype(np.uint16) * 257),
    "rgb.jpg": jpeg,
    "cmyk.jpg": write_cmyk,
    "grey.jpg": lambda path, rgb: jpeg(path, rgb[..., 0]),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_becomes_8_bit_rgb_of_the_same_levels(tmp_path, name):
    rgb = two_colours()
    got = read_image(inspect_image(FORMATS[name](tmp_path / name, rgb)), max_size=1600).rgb
    want = np.repeat(rgb[..., :1], 3, axis=2) if name.startswith("grey") else rgb
    assert got.dtype == np.uint8 and got.shape == want.shape and got.flags.c_contiguous
    tolerance = 4 if name.endswith(".jpg") else 0
    inner = (slice(8, -8), [10, 20, 30, 60, 70, 80])  # away from the edge, where JPEG rings
    assert np.abs(got[inner].astype(int) - want[inner]).max() <= tolerance


@pytest.mark.parametrize(
    ("max_size", "enlarge", "longer"),
    [
        (333, 1.0, 333),
        (500, 2.0, 500),
        (1000, 1.0, 1000),
        (5000, 1.0, 1000),
        (5000, 2.0, 2000),
        (1300, 2.0, 1300),
    ],
)
def test_a_point_maps_to_itself_through_the_resizing(tmp_path, max_size, enlarge, longer):
    height, width, point = 700, 1000, np.asarray([611.3, 248.8])
    y, x = np.mgrid[:height, :width]
    blob = np.exp(-((x - point[0]) ** 2 + (y - point[1]) ** 2) / (2 * 20.0**2))
    grey = np.round(255 * blob).astype(np.uint8)
    image = inspect_image(write_png(tmp_path / "a.png", np.dstack([grey] * 3)))
    working = read_image(image, max_size=max_size, enlarge=enlarge)
    small = working.rgb[..., 1].astype(float)
    assert max(small.shape) == longer
    ys, xs = np.mgrid[: small.shape[0], : small.shape[1]]
    centroid = np.asarray([(xs * small).sum(), (ys * small).sum()]) / small.sum()
    back = (centroid + 0.5) * working.scale - 0.5
    assert np.abs(back - point).max() < 0.05


def test_an_image_too_narrow_after_reduction_is_refused(tmp_path):
    image = inspect_image(write_png(tmp_path / "strip.png", two_colours(60, 600)))
    with pytest.raises(ImageError, match="strip.png: 100 x 10 pixels after reduction"):
        read_image(image, max_size=100)


@pytest.mark.parametrize(("limit", "factor"), [(480_000, 1), (200_000, 2), (20_000, 8)])
def test_a_huge_jpeg_is_decoded_at_reduced_size(tmp_path, monkeypatch, limit, factor):
    image = inspect_image(jpeg(tmp_path / "a.jpg", two_colours(600, 800)))
    monkeypatch.setattr(images, "MAX_DECODED_PIXELS", limit)
    decoded = []
    imdecode = cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda *a: decoded.append(imdecode(*a)) or decoded[-1])
    working = read_image(image, max_size=96)
    assert decoded[0].shape == (600 // factor, 800 // factor, 3)
    assert working.rgb.shape == (72, 96, 3)
    assert working.scale == pytest.approx((800 / 96, 600 / 72))
    assert np.abs(working.rgb[36, [20, 75]].astype(int) - [LEFT, RIGHT]).max() <= 4


def test_a_huge_jpeg_keeps_its_pixels_as_stored(tmp_path, monkeypatch):
    exif = Image.Exif()
    exif[0x0112] = 6
    image = inspect_image(jpeg(tmp_path / "a.jpg", two_colours(600, 800), exif=exif))
    monkeypatch.setattr(images, "MAX_DECODED_PIXELS", 200_000)
    rgb = read_image(image, max_size=96).rgb
    assert rgb.shape == (72, 96, 3)
    assert np.abs(rgb[36, [20, 75]].astype(int) - [LEFT, RIGHT]).max() <= 4


def test_what_cannot_be_decoded_reduced_is_refused_by_name(tmp_path, monkeypatch):
    png = inspect_image(write_png(tmp_path / "huge.png", two_colours(100, 100)))
    photo = inspect_image(jpeg(tmp_path / "huge.jpg", two_colours(100, 100)))
    monkeypatch.setattr(images, "MAX_DECODED_PIXELS", 100)
    for image in (png, photo):  # the photo is too large even at 1/8 of its size
        with pytest.raises(ImageError, match=f"{image.name}: 100 x 100 pixels is more than"):
            read_image(image, max_size=96)


def test_a_photo_changed_since_it_was_inspected_is_refused(tmp_path):
    """Else its features would be stored under the hash of the old content."""
    image = inspect_image(write_png(tmp_path / "a.png", two_colours()))
    write_png(tmp_path / "a.png", two_colours()[:, ::-1])
    with pytest.raises(ImageError, match="a.png: the file has changed since") as error:
        read_image(image, max_size=1600)
    assert not isinstance(error.value, DamagedImage)


def test_what_may_pass_is_no_damage(tmp_path):
    image = inspect_image(write_png(tmp_path / "a.png", two_colours(64, 640)))
    with pytest.raises(ImageError, match="too narrow") as narrow:
        read_image(image, max_size=100)
    image.path.unlink()
    with pytest.raises(ImageError, match="cannot be read") as gone:
        read_image(image, max_size=1600)
    assert not isinstance(narrow.value, DamagedImage) and not isinstance(gone.value, DamagedImage)
    data = bytearray(write_png(tmp_path / "b.png", two_colours()).read_bytes())
    data[-60:-20] = bytes(40)
    (tmp_path / "b.png").write_bytes(data)
    with pytest.raises(DamagedImage):
        read_image(inspect_image(tmp_path / "b.png"), max_size=1600)
