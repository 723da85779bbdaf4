"""Laws of panoramas: which photos are some, and what their pinhole views show."""

import dataclasses
import io
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxsfm.core.panorama import Direction, ViewSet, panorama_directions
from jaxsfm.io import panoramas
from jaxsfm.io.exif_data import ExifData
from jaxsfm.io.exif_gps import gps_of
from jaxsfm.io.images import ImageError, ImageFile, inspect_image
from jaxsfm.io.panoramas import (
    gps_as_exif,
    is_panorama,
    read_panorama,
    render_masks,
    render_views,
    view_as_jpeg,
    without_nadir,
)

VIEWS = ViewSet(
    (Direction(0, 0), Direction(180, 0), Direction(90, 40), Direction(0, 90), Direction(0, -90)),
    90.0,
)
GPANO = '<x xmlns:GPano="g" GPano:ProjectionType="equirectangular" {}/>'
PARTIAL = 'GPano:FullPanoWidthPixels="8000" GPano:CroppedAreaImageWidthPixels="256"'


def photo(folder: Path, size=(256, 128), name="a.jpg", **saved) -> ImageFile:
    folder.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (90, 120, 150)).save(folder / name, **saved)
    return inspect_image(folder / name, name=name)


def taken_with(maker: str, model: str) -> Image.Exif:
    exif = Image.Exif()
    exif[271], exif[272] = maker, model
    return exif


def smooth(directions: np.ndarray) -> np.ndarray:
    """A scene (n, 3) 0 .. 255 without fine detail, which a view must show as it is."""
    units = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return 127.5 + 120 * np.sin(3 * units + [0.0, 1.0, 2.0])


def panorama(width: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(width), np.arange(width // 2))
    xy = np.stack([x, y], axis=-1).astype(float)
    return np.round(smooth(panorama_directions(xy, (width, width // 2)))).astype(np.uint8)


@pytest.mark.parametrize(
    ("xmp", "is_one"),
    [
        (GPANO.format(""), True),
        ("<GPano:ProjectionType>equirectangular</GPano:ProjectionType>", True),
        (GPANO.format(PARTIAL), False),
        (GPANO.format(PARTIAL.replace("8000", "256")), True),
        (GPANO.format("").replace("equirectangular", "cylindrical"), False),
        ("<x/>", False),
    ],
)
def test_xmp_data_say_that_a_photo_is_a_panorama_of_the_whole_sphere(tmp_path, xmp, is_one):
    assert is_panorama(photo(tmp_path, xmp=xmp.encode())) == is_one


def test_png_files_are_known_by_their_xmp_data_too(tmp_path):
    from PIL import PngImagePlugin

    info = PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", GPANO.format(""))
    assert is_panorama(photo(tmp_path, name="a.png", pnginfo=info))


def test_a_360_degree_camera_in_exif_makes_a_photo_of_two_to_one_a_panorama(tmp_path):
    ricoh = taken_with("RICOH", "RICOH THETA Z1")
    assert is_panorama(photo(tmp_path, exif=ricoh))
    assert not is_panorama(photo(tmp_path, (250, 128), exif=ricoh))
    image, raw = photo(tmp_path, exif=ricoh), tmp_path / "a.dng"  # two fisheye pictures
    raw.write_bytes(image.path.read_bytes())
    assert is_panorama(image) and not is_panorama(dataclasses.replace(image, path=raw))
    assert not is_panorama(photo(tmp_path, exif=taken_with("NIKON", "D90")))
    assert not is_panorama(photo(tmp_path))


@pytest.mark.parametrize("width", [512, 2048])
def test_views_show_the_scene_in_the_direction_of_each_pixel(width):
    """At the seam and at the poles too, and where the panorama is much finer than the view."""
    side = 96
    rays = VIEWS.rays(side)
    shown = render_views(panorama(width), VIEWS, side)
    for rotation, view in zip(VIEWS.rotations(), shown, strict=True):
        np.testing.assert_allclose(view, smooth(rays @ rotation), atol=3.0)


@pytest.mark.parametrize("stripes", ["columns", "rows"])
def test_what_is_finer_than_a_pixel_of_the_view_is_grey(stripes):
    """Stripes of one pixel: a sample of single pixels would show some of them, and moire."""
    dark = np.zeros((512, 1024, 3), np.uint8)
    if stripes == "columns":
        dark[:, ::2] = 255
    else:
        dark[::2] = 255
    for view in render_views(dark, VIEWS, 48):
        inner = view[1:-1, 1:-1].astype(float)
        assert abs(inner - 127.5).max() < 40, abs(inner - 127.5).max()
        assert inner.std() < 12


def test_a_view_as_fine_as_the_panorama_keeps_its_detail():
    """The filter takes away no more than interpolation does."""
    fine = np.zeros((256, 512, 3), np.uint8)
    fine[:, ::4] = fine[:, 1::4] = 255
    side = VIEWS.side(512, most=10**6)
    front = next(render_views(fine, VIEWS, side)).astype(float)
    assert front[side // 2].std() > 80


@pytest.mark.parametrize("band", [1, 1000])
def test_views_do_not_depend_on_how_many_samples_are_interpolated_at_once(monkeypatch, band):
    """At the seam and at the poles, whose bands go all around, too."""
    rgb = np.random.default_rng(0).integers(0, 256, (128, 256, 3), np.uint8)
    whole = [*render_views(rgb, VIEWS, 48)]
    monkeypatch.setattr(panoramas, "BAND", band)
    for view, again in zip(whole, render_views(rgb, VIEWS, 48), strict=True):
        np.testing.assert_allclose(view.astype(int), again, atol=1)


def test_rendering_a_large_panorama_needs_no_second_one():
    rgb = np.zeros((4096, 8192, 3), np.uint8)
    tracemalloc.start()
    try:
        next(render_views(rgb, VIEWS, 400))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < rgb.nbytes / 2


@pytest.mark.parametrize("height", [256, 257])
def test_a_panorama_that_is_too_large_is_decoded_smaller(tmp_path, monkeypatch, height):
    Image.fromarray(panorama(2 * height)).save(tmp_path / "a.jpg", quality=95)
    Image.fromarray(panorama(2 * height)).save(tmp_path / "a.png")
    monkeypatch.setattr("jaxsfm.io.images.MAX_DECODED_PIXELS", 2 * height**2 - 1)
    rgb, _ = read_panorama(inspect_image(tmp_path / "a.jpg"))
    assert rgb.shape == (height // 2, 2 * (height // 2), 3)
    np.testing.assert_allclose(rgb, panorama(2 * (height // 2)), atol=12)
    with pytest.raises(ImageError, match="a.png: .* is more than can be decoded"):
        read_panorama(inspect_image(tmp_path / "a.png"))


def test_a_panorama_of_another_shape_is_an_error():
    with pytest.raises(ValueError, match="twice as wide as high; got 100 x 60"):
        next(render_views(np.zeros((60, 100, 3), np.uint8), VIEWS, 32))


def test_a_pixel_of_a_view_is_used_only_if_all_that_it_shows_is():
    used = without_nadir((1024, 512), 30.0)
    rays = VIEWS.rays(64)
    masks = [*render_masks(used, VIEWS, 64)]
    for rotation, mask in zip(VIEWS.rotations(), masks, strict=True):
        down = (rays @ rotation)[..., 1] / np.linalg.norm(rays, axis=-1)
        angle = np.degrees(np.arccos(np.clip(down, -1, 1)))
        assert not mask[angle < 30].any() and mask[angle > 32].all()
    assert masks[0].all() and not masks[4].all()


def test_views_have_the_gps_position_of_their_panorama(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(
        {1: "N", 2: (50.0, 30.0, 0.0), 3: "E", 4: (4.0, 0.0, 0.0), 5: b"\0", 6: 120.0}
    )
    whole = photo(tmp_path, exif=exif)
    data = view_as_jpeg(np.full((64, 64, 3), 128, np.uint8), gps_as_exif(whole), 95)
    assert Image.open(io.BytesIO(data)).size == (64, 64)
    (tmp_path / "view.jpg").write_bytes(data)
    found = gps_of(inspect_image(tmp_path / "view.jpg"))
    assert found is not None and found == gps_of(whole)
    assert (found.x, found.y, found.z) == (4.0, 50.5, 120.0)


def test_gps_that_cannot_be_written_is_left_out_of_views(tmp_path, monkeypatch):
    whole = photo(tmp_path)
    monkeypatch.setattr(panoramas, "exif_data", lambda _: ExifData({}, {2: object()}))
    data = view_as_jpeg(np.full((64, 64, 3), 128, np.uint8), gps_as_exif(whole), 95)
    assert not Image.open(io.BytesIO(data)).getexif().get_ifd(0x8825)
