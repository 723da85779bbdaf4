"""Laws of the photos of a run and of their working sizes."""

import numpy as np
import pytest
from test_read_image import two_colours, write_png

from jaxsfm.config import Config
from jaxsfm.io.images import inspect_image
from jaxsfm.io.photos import Photos


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
