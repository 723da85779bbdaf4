"""Which pixels of a photo are used."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from jaxsfm.errors import UserError
from jaxsfm.io.images import (
    ImageError,
    ImageFile,
    inspect_image,
    read_image,
)
from jaxsfm.io.masks import BLANK, mask_path, without_blank_border
from jaxsfm.io.photo_folder import masks_of, with_mask, with_masks
from jaxsfm.io.photos import intensities

SIZE = (90, 60)


def photo(folder: Path, name: str = "a.jpg", size=SIZE, value: int = 128) -> ImageFile:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (value, value, value)).save(path)
    return inspect_image(path, name=name)


def mask(path: Path, used: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), 255 * used.astype(np.uint8))
    return path


def left_half(size=SIZE) -> np.ndarray:
    used = np.ones(size[::-1], bool)
    used[:, : size[0] // 2] = False
    return used


def test_the_mask_of_a_photo_has_its_name_and_png(tmp_path):
    assert mask_path(tmp_path, "sub/a.jpg") == tmp_path / "sub" / "a.jpg.png"
    images = [photo(tmp_path / "p", name) for name in ("sub/a.jpg", "b.jpg")]
    mask(tmp_path / "m" / "sub" / "a.jpg.png", left_half())
    masked, bare = with_masks(images, tmp_path / "m")
    assert bare == ["b.jpg"] and masks_of(masked).keys() == {"sub/a.jpg"}
    np.testing.assert_array_equal(read_image(masked[0], max_size=90).used, left_half())
    assert read_image(masked[1], max_size=90).used is None


def test_one_file_is_the_mask_of_all_photos_of_its_size(tmp_path):
    images = [photo(tmp_path / "p", "sub/a.jpg"), photo(tmp_path / "p", "b.jpg", (60, 90))]
    one = mask(tmp_path / "m.png", left_half())
    assert mask_path(one, "sub/a.jpg") == one
    masked, bare = with_masks(images, one)
    assert bare == ["b.jpg"] and masks_of(masked).keys() == {"sub/a.jpg"}
    np.testing.assert_array_equal(read_image(masked[0], max_size=90).used, left_half())
    with pytest.raises(UserError, match="the mask of b.jpg has another size"):
        with_masks(images[1:], one)
    with pytest.raises(UserError, match="no such folder or file"):
        with_masks(images, tmp_path / "nowhere")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(UserError, match="not a readable mask"):
        with_masks(images, tmp_path / "text.png")


def test_black_is_ignored_and_everything_else_is_used(tmp_path):
    gray = np.asarray([[0, 1], [128, 255]], np.uint8).repeat(30, 0).repeat(45, 1)
    assert cv2.imwrite(str(tmp_path / "m.png"), gray)
    image = with_mask(photo(tmp_path), tmp_path / "m.png")
    np.testing.assert_array_equal(read_image(image, max_size=90).used, gray > 0)


def test_a_working_pixel_is_used_if_all_of_it_is(tmp_path):
    """The mask ends in the middle of a working pixel."""
    used = np.ones((180, 270), bool)
    used[:, :100] = False
    image = with_mask(photo(tmp_path, size=(270, 180)), mask(tmp_path / "m.png", used))
    found = read_image(image, max_size=90).used
    assert found is not None and found.shape == (60, 90)
    assert not found[:, :34].any() and found[:, 34:].all()


def test_the_mask_turns_with_the_photo(tmp_path):
    image = with_mask(photo(tmp_path), mask(tmp_path / "m.png", left_half()))
    turned = dataclasses.replace(image, orientation=6)
    upright = read_image(turned, max_size=90, upright=True).used
    np.testing.assert_array_equal(upright, np.rot90(left_half(), -1))


def test_intensities_of_unused_pixels_are_not_numbers(tmp_path):
    image = with_mask(photo(tmp_path), mask(tmp_path / "m.png", left_half()))
    gray = intensities(read_image(image, max_size=90))
    np.testing.assert_array_equal(np.isfinite(gray), left_half())


def test_another_mask_makes_other_features(tmp_path):
    plain = photo(tmp_path)
    one = with_mask(plain, mask(tmp_path / "1.png", left_half()))
    other = with_mask(plain, mask(tmp_path / "2.png", ~left_half()))
    assert len({plain.content, one.content, other.content}) == 3
    assert with_mask(plain, None) == plain


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: mask(path, left_half((60, 90))), "60 x 90 pixels and its photo 90 x 60"),
        (lambda path: mask(path, np.zeros(SIZE[::-1], bool)), "the mask is black"),
        (lambda path: path.write_bytes(b"no image"), "not a readable mask"),
        (lambda path: path.write_bytes(b""), "not a readable mask"),
        (lambda path: None, "cannot be read"),
    ],
    ids=["another size", "black", "no image", "empty", "missing"],
)
def test_a_mask_that_cannot_be_used_is_named(tmp_path, make, message):
    make(tmp_path / "m.png")
    with pytest.raises(UserError, match=message) as error:
        with_mask(photo(tmp_path), tmp_path / "m.png")
    assert "m.png" in str(error.value) and "\n" not in str(error.value)


def test_a_folder_without_masks_is_refused(tmp_path):
    images = [photo(tmp_path / "p", "sub/a.jpg")]
    with pytest.raises(UserError, match=r"--masks .*: no such folder"):
        with_masks(images, tmp_path / "none")
    (tmp_path / "m").mkdir()
    with pytest.raises(UserError, match=r"no mask of any photo .*sub/a\.jpg\.png"):
        with_masks(images, tmp_path / "m")


@pytest.mark.parametrize("change", [Path.unlink, lambda path: path.write_bytes(b"x")])
def test_a_mask_that_is_gone_or_has_changed_is_an_error_of_its_photo(tmp_path, change):
    image = with_mask(photo(tmp_path), mask(tmp_path / "m.png", left_half()))
    change(tmp_path / "m.png")
    with pytest.raises(ImageError, match=r"^a\.jpg: .*m\.png"):
        read_image(image, max_size=90)


# -- blank borders ---------------------------------------------------------------------------------


def rectified(value: int = 0) -> np.ndarray:
    """Content with a curved border on the left, and a dark place inside."""
    rows, columns = np.indices(SIZE[::-1])
    inside = columns > 10 + ((rows - 30) / 10) ** 2
    rgb = np.where(inside[..., None], 100, value).astype(np.uint8).repeat(3, 2)
    rgb[25:35, 50:70] = 0
    return rgb


@pytest.mark.parametrize("value", [0, BLANK])
def test_a_blank_border_is_not_used_and_a_dark_place_inside_is(value):
    rgb = rectified(value)
    used = without_blank_border(rgb)
    assert used is not None and used[30, 60]
    expected = (rgb > BLANK).all(-1)
    assert (used != expected)[:, :50].sum() <= 4  # the tips in the corners are narrow
    assert not used[:, :11].any() and used[:, 20:50].all()


def test_dark_but_not_blank_borders_are_used():
    assert without_blank_border(rectified(BLANK + 1)) is None


def test_a_narrow_frame_is_used():
    rgb = np.full((600, 900, 3), 100, np.uint8)
    rgb[:, 0] = 0
    assert without_blank_border(rgb) is None
    rgb[:, :30] = 0
    assert without_blank_border(rgb) is not None


def test_the_border_and_the_mask_are_both_left_out(tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), rectified())
    image = inspect_image(tmp_path / "a.png")
    border = read_image(image, max_size=90).used
    masked = with_mask(image, mask(tmp_path / "m.png", left_half()))
    used = read_image(masked, max_size=90).used
    assert border is not None and used is not None
    np.testing.assert_array_equal(used, border & left_half())


def test_dark_pixels_that_touch_the_border_by_chance_are_used():
    """A night with noise: the blank pixels form lines, and no area."""
    rgb = np.full((60, 90, 3), 100, np.uint8)
    rgb[::3] = 0
    rgb[:, ::4] = 0
    assert (rgb[0] == 0).all() and (rgb == 0).mean() > 0.4
    assert without_blank_border(rgb) is None


def test_a_blank_border_is_all_blank_parts_that_touch_the_border():
    for seed in range(20):
        coarse = np.random.default_rng(seed).integers(0, 2, (9, 13), np.uint8)
        blank = coarse.repeat(11, 0).repeat(11, 1) == 1
        parts, _ = ndimage.label(blank)
        edges = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
        outer = np.isin(parts, np.setdiff1d(edges, [0]))
        used = without_blank_border(np.where(blank[..., None], 0, 90).astype(np.uint8).repeat(3, 2))
        np.testing.assert_array_equal(True if used is None else used, ~outer)
