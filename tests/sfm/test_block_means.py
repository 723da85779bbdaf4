"""Images at octaves, where some pixels are not used."""

import numpy as np

from jaxsfm.sfm.refine.device_images import block_means


def image() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 255, (9, 14)).astype(np.float32)


def test_a_large_pixel_is_the_mean_of_those_it_covers():
    whole = image()
    np.testing.assert_allclose(block_means(whole, 4)[1, 2], whole[4:8, 8:12].mean(), rtol=1e-6)
    assert block_means(whole, 4).shape == (2, 3) and block_means(whole, 1) is whole


def test_unused_pixels_take_no_part_in_the_mean():
    some = image()
    some[4:6, 8:12] = np.nan  # half of a large pixel
    means = block_means(some, 4)
    np.testing.assert_allclose(means[1, 2], some[6:8, 8:12].mean(), rtol=1e-6)
    np.testing.assert_allclose(np.delete(means, 5), np.delete(block_means(image(), 4), 5))
    assert means.dtype == np.float32


def test_a_large_pixel_of_which_less_than_half_is_used_is_not_used():
    some = image()
    some[4:6, 8:12] = some[6, 8] = np.nan
    means = block_means(some, 4)
    assert np.isnan(means[1, 2]) and np.isfinite(np.delete(means, 5)).all()
