"""Laws of the photos of a run, of their working sizes, and of how pixels lie on each other."""

import numpy as np
import pytest
from test_read_image import two_colours, write_png

from jaxsfm.config import Config
from jaxsfm.io.images import inspect_image
from jaxsfm.io.photos import Photos, Pixels


@pytest.mark.parametrize(("max_size", "enlarge"), [(80, 1.0), (101, 1.0), (400, 1.0), (400, 2.5)])
@pytest.mark.parametrize("size", [(96, 64), (64, 96), (97, 61), (300, 201)])
def test_the_working_size_is_that_of_the_image_that_is_read(tmp_path, size, max_size, enlarge):
    """So a model can be converted before its photos are read."""
    file = inspect_image(write_png(tmp_path / "a.png", two_colours(size[1], size[0])))
    photos = Photos([file], Config(max_size=max_size, enlarge=enlarge))
    (width, height), scale = photos.working_size(file.name)
    rgb, read_scale, _ = photos.rgb(file.name)
    gray, gray_scale = photos.gray(file.name)
    assert rgb.shape == (height, width, 3) and gray.shape == (height, width)
    assert scale == read_scale == gray_scale
    np.testing.assert_allclose(np.multiply(scale, (width, height)), size)


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.5, 100, (50, 2))


def test_there_and_back_is_where_it_was(points):
    pixels = Pixels((2.5, 3.0))
    np.testing.assert_allclose(pixels.from_original(pixels.to_original(points)), points, atol=1e-12)
    np.testing.assert_allclose(pixels.from_colmap(pixels.to_colmap(points)), points, atol=1e-12)


def test_a_pixel_of_the_second_octave_has_its_centre_between_four():
    # The first pixel covers (0, 0), (1, 0), (0, 1) and (1, 1), whose mean is (0.5, 0.5).
    assert Pixels.octave(2).to_original(np.zeros(2)).tolist() == [0.5, 0.5]


def test_the_corner_of_the_image_stays_the_corner(points):
    corner = np.asarray([-0.5, -0.5])
    assert Pixels((2.5, 3.0)).to_original(corner).tolist() == corner.tolist()
    assert Pixels((2.5, 3.0)).to_colmap(corner).tolist() == [0.0, 0.0]


def test_the_matrix_moves_points_as_the_function_does(points):
    pixels = Pixels((2.5, 3.0))
    moved = np.column_stack([points, np.ones(len(points))]) @ pixels.matrix().T
    np.testing.assert_allclose(moved[:, :2], pixels.to_original(points), atol=1e-12)
