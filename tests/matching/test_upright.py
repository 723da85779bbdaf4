"""Photos that are stored sideways are matched as if they were upright."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxsfm.config import preset
from jaxsfm.io import orientation
from jaxsfm.io.images import ImageFile, inspect_image
from jaxsfm.io.pairs import PairResult
from jaxsfm.matching.extraction import image_features
from jaxsfm.matching.pair_matching import match_features

CONFIG = preset("default")
WIDTH, HEIGHT = 240, 180


@pytest.fixture(scope="module")
def views(photos) -> tuple[np.ndarray, np.ndarray]:
    """Two cuts of a photo, (HEIGHT, WIDTH, 3)."""
    rgb = photos[0]
    cuts = (rgb[y : y + HEIGHT, x : x + WIDTH] for x, y in ((40, 60), (64, 76)))
    first, second = (np.ascontiguousarray(cut) for cut in cuts)
    return first, second


def stored(folder: Path, name: str, rgb: np.ndarray, code: int) -> ImageFile:
    """A file whose pixels become `rgb` when they are turned as `code` says."""
    inverse = next(
        c
        for c in orientation.CODES
        if np.array_equal(orientation.upright(orientation.upright(rgb, c), code), rgb)
    )
    exif = Image.Exif()
    exif[0x0112] = code
    path = folder / f"{name}{code}.png"
    Image.fromarray(np.ascontiguousarray(orientation.upright(rgb, inverse))).save(path, exif=exif)
    return inspect_image(path, name=name)


@pytest.fixture(scope="module")
def matched(tmp_path_factory, views, weights):
    folder = tmp_path_factory.mktemp("upright")
    first = stored(folder, "a", views[0], 1)
    second = {code: stored(folder, "b", views[1], code) for code in (1, 3, 6, 7)}
    own = image_features(weights, first, config=CONFIG)

    def match(code: int) -> PairResult:
        # The random key depends on the files' contents, which are not the same here.
        image = dataclasses.replace(second[code], sha256=second[1].sha256)
        found = image_features(weights, second[code], config=CONFIG)._replace(image=image)
        return match_features(own, found, config=CONFIG)

    return {code: match(code) for code in second}


@pytest.mark.parametrize("code", [3, 6, 7])
def test_matches_of_a_turned_photo_are_those_of_the_upright_one(matched, code):
    upright, turned = matched[1], matched[code]
    assert upright.num_inliers > 50
    np.testing.assert_array_equal(turned.cells, upright.cells)
    np.testing.assert_array_equal(turned.keypoints0, upright.keypoints0)
    size = (WIDTH, HEIGHT) if code == 3 else (HEIGHT, WIDTH)
    back = orientation.stored_points(upright.keypoints1.astype(np.float64), size, code)
    # Equal but for the rounding to float32: keypoints are written in pixels of the stored photo.
    np.testing.assert_allclose(turned.keypoints1, back, atol=1e-4)


@pytest.mark.parametrize("code", [3, 6, 7])
def test_homographies_map_to_the_stored_pixels(matched, code):
    found = matched[code]
    for match, plane in enumerate(found.plane):
        x, y, w = found.homographies[plane] @ [*found.keypoints0[match], 1]
        assert (
            np.hypot(*(np.asarray([x, y]) / w - found.keypoints1[match]))
            < 1.5 * CONFIG.threshold_px
        )
