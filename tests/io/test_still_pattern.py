"""What shows at the same pixels in all photos is found, and nothing else is."""

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
from textures import texture

from jaxsfm.io import still_pattern
from jaxsfm.io.images import ImageFile, WorkingImage, inspect_image, read_image
from jaxsfm.io.masks import open_mask, read_mask
from jaxsfm.io.photo_folder import with_mask
from jaxsfm.io.still_pattern import (
    LEAST_PHOTOS,
    MOST_PHOTOS,
    WINDOW,
    StillPattern,
    correlation,
    find_still_pattern,
)

SIZE = (640, 480)
PATTERN = (slice(380, 460), slice(60, 340))
"""The rows and columns of a pattern that stays."""


@functools.cache
def scene(seed: int = 0) -> np.ndarray:
    """uint8 (1200, 1600)."""
    return np.clip(128 + 60 * texture(seed, (1600, 1200)), 0, 255).astype(np.uint8)


def view(k: int, step: int = 37, seed: int = 0) -> np.ndarray:
    """The part of the texture that a camera sees after k steps."""
    left, top = (k * step) % 900, (k * step * 7) % 700
    return scene(seed)[top : top + SIZE[1], left : left + SIZE[0]].copy()


def photos(folder: Path, views: list[np.ndarray], quality: int = 85) -> list[ImageFile]:
    for k, each in enumerate(views):
        path = str(folder / f"{k:02}.jpg")
        assert cv2.imwrite(path, each, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return [inspect_image(path, name=path.name) for path in sorted(folder.glob("*.jpg"))]


def stamped(views: list[np.ndarray], opacity: float = 1.0) -> list[np.ndarray]:
    """Views with the same small picture in front of them."""
    stamp = scene(1)[:80, :280]
    for each in views:
        each[PATTERN] = opacity * stamp + (1 - opacity) * each[PATTERN]
    return views


def test_a_camera_that_moves_shows_nothing_that_stays(tmp_path):
    assert find_still_pattern(photos(tmp_path, [view(k) for k in range(12)])) is None


@pytest.mark.parametrize("opacity", [1.0, 0.85])
def test_what_stays_is_found_where_it_is(tmp_path, opacity):
    found = find_still_pattern(photos(tmp_path, stamped([view(k) for k in range(12)], opacity)))
    assert found is not None and found.photos == 12
    where = np.zeros(SIZE[::-1], bool)
    where[PATTERN] = True
    assert found.still[where].mean() > 0.9
    around = cv2.dilate(where.astype(np.uint8), np.ones((3 * WINDOW, 3 * WINDOW))) > 0
    assert not found.still[~around].any()


def test_a_still_background_is_found_behind_what_turns(tmp_path):
    views = [scene(2)[: SIZE[1], : SIZE[0]].copy() for _ in range(10)]
    for k, each in enumerate(views):
        each[120:360, 200:440] = view(k)[:240, :240]
    found = find_still_pattern(photos(tmp_path, views))
    assert found is not None and 0.75 < found.share < 1 - 0.8 * 240 * 240 / (640 * 480)
    assert not found.still[150:330, 230:410].any()


def test_noise_and_plain_areas_do_not_stay(tmp_path):
    """Black is black in every photo, but nothing can be matched there."""
    random = np.random.default_rng(0)
    views = [np.clip(random.normal(9, 3, SIZE[::-1]), 0, 255).astype(np.uint8) for _ in range(9)]
    for k, each in enumerate(views):
        each[:200], each[200:400, 80:] = 0, view(k)[:200, 80:]
    assert find_still_pattern(photos(tmp_path, views)) is None


def test_too_few_photos_say_nothing(tmp_path):
    few = photos(tmp_path, stamped([view(k) for k in range(LEAST_PHOTOS - 1)]))
    assert find_still_pattern(few) is None
    assert find_still_pattern([]) is None


def test_photos_of_another_size_and_damaged_ones_are_left_out(tmp_path):
    images = photos(tmp_path, stamped([view(k) for k in range(LEAST_PHOTOS + 1)]))
    assert cv2.imwrite(str(tmp_path / "z.jpg"), scene())
    odd = inspect_image(tmp_path / "z.jpg", name="z.jpg")
    found = find_still_pattern([*images, odd])
    assert found is not None and found.photos == LEAST_PHOTOS + 1
    (tmp_path / images[3].name).write_bytes(b"gone")
    assert find_still_pattern([*images, odd]) is not None
    (tmp_path / images[4].name).write_bytes(b"gone")
    assert find_still_pattern([*images, odd]) is None


def test_what_is_masked_already_is_not_found(tmp_path):
    images = photos(tmp_path, stamped([view(k) for k in range(10)]))
    used = np.full(SIZE[::-1], 255, np.uint8)
    used[PATTERN] = 0
    assert cv2.imwrite(str(tmp_path / "mask.png"), used)
    assert find_still_pattern(images) is not None
    masked = [with_mask(image, tmp_path / "mask.png") for image in images]
    assert find_still_pattern(masked) is None


def test_only_some_of_many_photos_are_read(tmp_path, monkeypatch):
    images, read = photos(tmp_path, [view(k) for k in range(2 * MOST_PHOTOS + 1)]), []

    def counted(image: ImageFile, **how) -> WorkingImage:
        read.append(image.name)
        return read_image(image, **how)

    monkeypatch.setattr(still_pattern, "read_image", counted)
    assert find_still_pattern(images) is None
    assert len(read) == MOST_PHOTOS
    assert {read[0], read[-1]} == {images[0].name, images[-1].name}


def test_the_mask_hides_what_stays(tmp_path):
    still = np.zeros(SIZE[::-1], bool)
    still[PATTERN] = True
    (tmp_path / "mask.png").write_bytes(StillPattern(still, 9).mask())
    np.testing.assert_array_equal(read_mask(open_mask(tmp_path / "mask.png", SIZE)), ~still)


def test_the_correlation_is_one_for_the_same_and_near_nought_for_others():
    random = np.random.default_rng(0)
    others = random.normal(128, 20, (10, 60, 80)).astype(np.float32)
    np.testing.assert_allclose(correlation(others[:1].repeat(10, 0)), 1, atol=1e-3)
    assert np.abs(correlation(others)).max() < 0.4
    assert np.abs(correlation(others).mean()) < 0.03
    assert (correlation(np.full((10, 60, 80), 7, np.float32)) == 0).all()
