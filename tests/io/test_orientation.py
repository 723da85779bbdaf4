"""Photos that are not stored upright."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from jaxsfm.io import orientation
from jaxsfm.io.images import inspect_image, orientations, read_image

SIZE = (60, 50)


def pixels() -> np.ndarray:
    """A photo in which every pixel has another colour."""
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    return np.stack([4 * columns, 5 * rows, 0 * rows], axis=2).astype(np.uint8)


def tagged(path: Path, rgb: np.ndarray, code: int, kind: str = "PNG") -> Path:
    exif = Image.Exif()
    exif[0x0112] = code
    Image.fromarray(rgb).save(path, kind, exif=exif)
    return path


@pytest.mark.parametrize("code", orientation.CODES)
def test_upright_is_what_pillow_makes_of_the_note(tmp_path, code):
    path = tagged(tmp_path / "a.png", pixels(), code)
    with Image.open(path) as stored:
        expected = np.asarray(ImageOps.exif_transpose(stored))
    np.testing.assert_array_equal(orientation.upright(pixels(), code), expected)
    assert orientation.upright_size(SIZE, code) == expected.shape[1::-1]


@pytest.mark.parametrize("code", orientation.CODES)
def test_each_upright_pixel_is_found_among_the_stored_ones(code):
    upright = orientation.upright(pixels(), code)
    rows, columns = np.indices(upright.shape[:2]).reshape(2, -1)
    xy = orientation.stored_points(np.column_stack([columns, rows]).astype(float), SIZE, code)
    x, y = xy.astype(int).T
    np.testing.assert_array_equal(pixels()[y, x], upright[rows, columns])


@pytest.mark.parametrize(("code", "quarters"), [*itertools.product(orientation.CODES, range(5))])
def test_a_further_turn_turns_the_upright_picture(code, quarters):
    both = orientation.upright(pixels(), orientation.turned(code, quarters))
    np.testing.assert_array_equal(both, np.rot90(orientation.upright(pixels(), code), -quarters))


@pytest.mark.parametrize("code", orientation.CODES)
def test_a_photo_is_read_as_stored_unless_it_is_asked_for_upright(tmp_path, code):
    image = inspect_image(tagged(tmp_path / "a.png", pixels(), code))
    assert (image.size, image.orientation) == (SIZE, code)
    np.testing.assert_array_equal(read_image(image, max_size=60).rgb, pixels())
    upright = read_image(image, max_size=60, upright=True)
    np.testing.assert_array_equal(upright.rgb, orientation.upright(pixels(), code))
    assert upright.scale == (1, 1)


def test_a_turned_photo_is_reduced_as_the_upright_one(tmp_path):
    plain = inspect_image(tagged(tmp_path / "a.png", pixels(), 1))
    stored = np.rot90(pixels())  # a quarter turn against the clock, undone by code 6
    image = inspect_image(tagged(tmp_path / "b.png", np.ascontiguousarray(stored), 6))
    assert image.size == (50, 60) and image.upright_size == plain.size == SIZE
    expected, found = (read_image(i, max_size=58, upright=True) for i in (plain, image))
    np.testing.assert_array_equal(found.rgb, expected.rgb)
    assert found.scale == expected.scale != (1, 1)


@pytest.mark.parametrize("code", [0, 9, 65535])
def test_a_note_that_is_no_code_is_ignored(tmp_path, code):
    assert inspect_image(tagged(tmp_path / "a.jpg", pixels(), code, "JPEG")).orientation == 1


@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
@pytest.mark.parametrize("code", [0, 9, 65535])
def test_a_photo_with_a_note_that_is_no_code_runs_as_an_upright_one(tmp_path, code, kind):
    image = inspect_image(tagged(tmp_path / f"a.{kind.lower()}", pixels(), code, kind))
    assert (image.orientation, image.upright_size) == (1, SIZE)
    assert image.content == image.sha256 and orientations([image]) == {}
    for upright in (False, True):
        np.testing.assert_array_equal(read_image(image, max_size=60, upright=upright).rgb, pixels())


def test_damaged_exif_is_ignored(tmp_path):
    Image.fromarray(pixels()).save(tmp_path / "a.jpg", exif=b"Exif\x00\x00MM\x00*\xff\xff\xff\xff")
    assert inspect_image(tmp_path / "a.jpg").orientation == 1


def test_photos_without_exif_are_upright(tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), pixels())
    image = inspect_image(tmp_path / "a.png")
    assert image.orientation == 1 and image.content == image.sha256


def test_features_of_other_turns_are_other_features(tmp_path):
    one, other = (inspect_image(tagged(tmp_path / f"{c}.png", pixels(), c)) for c in (1, 6))
    assert other.content != other.sha256 and one.content == one.sha256
    assert orientations([one, other]) == {"6.png": 6}


@pytest.mark.parametrize("code", orientation.CODES)
def test_a_tiff_is_turned_once(tmp_path, code):
    """OpenCV turns it when it decodes it, whatever it is asked for."""
    image = inspect_image(tagged(tmp_path / "a.tif", pixels(), code, "TIFF"))
    read = read_image(image, max_size=60, upright=True)
    np.testing.assert_array_equal(read.rgb, orientation.upright(pixels(), code))
    assert image.size == image.upright_size == read.rgb.shape[1::-1]
