"""Photos in HEIC, AVIF and camera RAW."""

import io
import logging
import sys

import cv2
import numpy as np
import pytest
from moving_views import views
from PIL import ExifTags, Image, features
from raw_files import dng

from jaxsfm.io.decoders import open_header, special_format
from jaxsfm.io.images import DamagedImage, ImageError, inspect_image, read_image
from jaxsfm.io.photo_folder import find_images

ORIENTATION = ExifTags.Base.Orientation
QUARTERS = {1: 0, 6: -1, 3: 2, 8: 1}
"""EXIF orientation -> quarter turns to the left that make the picture upright."""
(BGR,) = views([0])
RGB = np.ascontiguousarray(cv2.GaussianBlur(BGR, (0, 0), 2)[..., ::-1])


def with_exif(orientation: int) -> bytes:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 28
    return exif.tobytes()


def heic(orientation: int = 1) -> bytes:
    pillow_heif = pytest.importorskip("pillow_heif")
    file = io.BytesIO()
    # pillow-heif writes the orientation as a turn, as phones do, and keeps the EXIF tag.
    pillow_heif.from_pillow(Image.fromarray(RGB)).save(
        file, quality=95, exif=with_exif(orientation)
    )
    return file.getvalue()


def avif(orientation: int = 1) -> bytes:
    if not features.check("avif"):
        pytest.skip("this Pillow has no AVIF")
    file = io.BytesIO()
    Image.fromarray(RGB).save(file, "AVIF", quality=95, exif=with_exif(orientation))
    return file.getvalue()


def raw(orientation: int = 1) -> bytes:
    pytest.importorskip("rawpy")
    return dng(RGB, orientation=orientation)


FORMATS = {".heic": heic, ".avif": avif, ".dng": raw}


def shown(path):
    """What the file shows after all turns, and how its pixels correlate with the picture's."""
    image = inspect_image(path)
    rgb = read_image(image, max_size=4000).rgb
    assert rgb.shape[:2] == image.size[::-1]
    return rgb


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("orientation", QUARTERS)
def test_size_and_pixels_agree_and_nothing_is_turned_twice(tmp_path, suffix, orientation):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(FORMATS[suffix](orientation))
    rgb = shown(path)
    with open_header(path.read_bytes(), suffix) as header:
        left = header.getexif().get(ORIENTATION, 1)
        assert header.size == rgb.shape[1::-1]
    # AVIF's pixels are as stored, and the tag says how to turn them; the others are upright.
    assert left == (orientation if suffix == ".avif" else 1)
    upright = np.rot90(rgb, QUARTERS[left])
    expected = np.rot90(RGB, QUARTERS[orientation])
    assert upright.shape == expected.shape
    same = np.corrcoef(upright.ravel().astype(float), expected.ravel().astype(float))[0, 1]
    assert same > 0.98
    if suffix != ".dng":  # LibRaw chooses brightness and contrast
        assert np.abs(upright.astype(float) - expected).mean() < 4


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_focal_length_in_exif_is_found(suffix):
    with open_header(FORMATS[suffix](), suffix) as header:
        found = header.getexif().get_ifd(ExifTags.IFD.Exif)
    assert found[ExifTags.Base.FocalLengthIn35mmFilm] == 28


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_damaged_file_is_an_error_of_that_photo(tmp_path, suffix):
    data = FORMATS[suffix]()
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data[:60])
    with pytest.raises(ImageError, match="not a readable image"):
        inspect_image(path)
    for length in (len(data) // 2, len(data) - 1000):
        path.write_bytes(data[:length])
        try:
            image = inspect_image(path)
        except ImageError:
            continue
        with pytest.raises(DamagedImage, match="cannot be decoded"):
            read_image(image, max_size=4000)


@pytest.mark.parametrize(
    "suffix, module, message",
    [
        (".heic", "pillow_heif", r"reading HEIC needs pip install 'jaxsfm\[formats\]'"),
        (".dng", "rawpy", r"reading camera RAW needs pip install 'jaxsfm\[formats\]'"),
    ],
)
def test_without_the_package_the_sentence_says_what_to_install(
    tmp_path, monkeypatch, suffix, module, message
):
    data = FORMATS[suffix]()
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    image = inspect_image(path)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImageError, match=f"a{suffix}: {message}"):
        inspect_image(path)
    with pytest.raises(ImageError, match=f"a{suffix}: {message}"):
        read_image(image, max_size=4000)


def test_with_an_old_pillow_the_sentence_says_what_to_install(tmp_path, monkeypatch):
    path = tmp_path / "a.avif"
    path.write_bytes(avif())
    monkeypatch.setattr(features, "check", lambda name: False)
    with pytest.raises(ImageError, match=r"a.avif: reading AVIF needs .*jaxsfm\[formats\]"):
        inspect_image(path)


def test_a_renamed_file_is_read_as_what_it_is(tmp_path):
    (tmp_path / "heic.jpg").write_bytes(heic())
    Image.fromarray(RGB).save(tmp_path / "jpeg.heic", "JPEG", quality=95)
    for name in ("heic.jpg", "jpeg.heic"):
        assert np.abs(shown(tmp_path / name).astype(float) - RGB).mean() < 4


def test_the_format_is_known_by_the_content_and_of_raw_by_the_suffix():
    for brands, kind in (
        ([b"heic", b"mif1"], "heic"),
        ([b"mif1", b"heic"], "heic"),
        ([b"mif1", b"avif"], "avif"),
        ([b"isom", b"mp41"], None),
    ):
        box = b"ftyp" + brands[0] + bytes(4) + b"".join(brands)
        data = (len(box) + 4).to_bytes(4, "big") + box + b"heicavif"
        assert special_format(data, ".jpg") == kind
    assert special_format(b"II*\0", ".DNG") == "raw"
    assert special_format(b"II*\0", ".tif") is None
    assert special_format(b"", ".heic") is None


def test_of_two_formats_of_one_photo_one_is_used(tmp_path, caplog):
    both = ["a.CR2", "a.jpg", "b.dng", "b.HEIC", "c.heic", "c.png", "d.nef", "sub/a.heic"]
    for name in (*both, "e.jpg", "e.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with caplog.at_level(logging.INFO, "jaxsfm"):
        found = find_images(tmp_path)
    assert found == ["a.jpg", "b.HEIC", "c.png", "d.nef", "e.jpg", "e.png", "sub/a.heic"]
    assert "another format: a.CR2, b.dng, c.heic" in caplog.text
