"""Laws of octaves: descriptors of smaller copies of the image, at the cells of the image."""

import numpy as np
import oracles
import pytest
import tolerances
from compiled import compiled
from described import compute_features
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import random_features, rng_of, seeds

from jaxsfm.config import Config, preset
from jaxsfm.core import octaves as core
from jaxsfm.core.octaves import octave_capacity
from jaxsfm.core.types import DenseFeatures
from jaxsfm.io.features import pad_features
from jaxsfm.io.images import WorkingImage

join, halve = compiled(core.join_octaves), compiled(core.halve)
smaller = compiled(core.smaller, "octave")
HALF = 0.5
"""An octave's products count half as much as those of the octave before."""
SHAPES = [(8, 12), (5, 7), (9, 4), (1, 6), (3, 3)]


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from(SHAPES), st.sampled_from([1, 2, 4]))
def test_joining_equals_interpolating_cell_by_cell(seed, shape, octaves):
    features = random_features(seed, shape, octaves)
    joined = join(features)
    for ours, levels, grid in (
        (joined.coarse, features.coarse, features.coarse_grid),
        (joined.fine, features.fine, features.fine_grid),
    ):
        expected = oracles.join_octaves(levels, grid, HALF)
        np.testing.assert_allclose(ours, expected, **tolerances.UNIT)


@settings(max_examples=20, deadline=None)
@given(seeds, st.sampled_from(SHAPES))
def test_products_are_weighted_means_over_the_octaves(seed, shape):
    features = random_features(seed, shape, 3)
    joined = join(features).coarse
    n = joined.shape[0]
    alive = joined.any(1)
    parts = joined.reshape(n, 3, -1)[alive]
    norms = np.linalg.norm(parts, axis=2, keepdims=True)
    weight = np.where(norms > 0, HALF ** np.arange(3.0)[None, :, None], 0)
    share = np.sqrt(weight / weight.sum(1, keepdims=True))
    np.testing.assert_allclose(norms, share, **tolerances.UNIT)


def test_there_is_room_for_every_cell_of_an_octave():
    assert [octave_capacity(n, 2) for n in (16, 17, 31, 32, 33)] == [1, 2, 2, 2, 3]
    assert [octave_capacity(1200, k) for k in range(4)] == [1200, 300, 75, 19]


def test_one_octave_is_left_as_it_is():
    features = random_features(0, (5, 7), 1)
    np.testing.assert_array_equal(join(features).coarse, features.coarse[0])


def test_halving_takes_means_of_two_by_two_pixels():
    x = rng_of(1).random((6, 4, 3), np.float32)
    ours = halve(x)
    np.testing.assert_allclose(ours[2, 1], x[4:6, 2:4].mean((0, 1)), **tolerances.UNIT)
    assert ours.shape == (3, 2, 3)


def of(weights, rgb, **options) -> DenseFeatures:
    working = WorkingImage(rgb=np.ascontiguousarray(rgb), scale=(1.0, 1.0))
    return compute_features(weights, working, config=Config(**options))


def cells_of(x, grid):
    return np.asarray(x)[: grid[0] * grid[1]]


@pytest.mark.slow
@pytest.mark.parametrize("size", [(256, 192), (250, 181)])
def test_an_octave_is_the_smaller_image_described_alone(weights, photos, size):
    small = photos[2][: size[1], : size[0]]
    whole = np.repeat(np.repeat(small, 2, axis=0), 2, axis=1)  # halving gives it back exactly
    octaves, alone = of(weights, whole, octaves=2), of(weights, small)
    for ours, expected, grid in (
        (octaves.coarse[1], alone.coarse[0], alone.coarse_grid),
        (octaves.fine[1], alone.fine[0], alone.fine_grid),
    ):
        np.testing.assert_allclose(
            cells_of(ours, grid), cells_of(expected, grid), **tolerances.FEATURES
        )
        assert not np.asarray(ours)[grid[0] * grid[1] :].any()


@pytest.mark.slow
def test_a_smaller_image_is_had_without_describing_it(weights, photos):
    """All but the keypoints, which lie at the centres of their cells."""
    small = photos[2][:192, :256]
    whole = np.repeat(np.repeat(small, 2, axis=0), 2, axis=1)
    ours = smaller(of(weights, whole, octaves=3), octave=1)
    alone = of(weights, small, octaves=3)
    np.testing.assert_array_equal(ours.coarse_grid, alone.coarse_grid)
    np.testing.assert_array_equal(ours.fine_grid, alone.fine_grid)
    grid = np.asarray(alone.fine_grid)
    for k in range(2):
        part = cells_of(ours.fine[k], grid >> k), cells_of(alone.fine[k], grid >> k)
        np.testing.assert_allclose(*part, **tolerances.FEATURES)
    assert not np.asarray(ours.fine[2]).any() and len(ours.fine) == 3
    centres = np.asarray(of(weights, small, keypoints="grid").keypoints)
    np.testing.assert_array_equal(cells_of(ours.keypoints, grid), cells_of(centres, grid))


@settings(max_examples=20, deadline=None)
@given(seeds, st.sampled_from([(8, 12), (5, 7), (9, 4)]), st.integers(0, 2))
def test_lacking_octaves_add_nothing_to_a_product(seed, shape, octave):
    features = random_features(seed, shape, 3)
    ours = join(smaller(features, octave=octave))
    left = features._replace(
        coarse=features.coarse[octave:],
        fine=features.fine[octave:],
        coarse_grid=features.coarse_grid >> octave,
        fine_grid=features.fine_grid >> octave,
    )
    for few, all_of_them in ((join(left).coarse, ours.coarse), (join(left).fine, ours.fine)):
        channels = few.shape[1]
        np.testing.assert_allclose(all_of_them[:, :channels], few, **tolerances.UNIT)
        assert not all_of_them[:, channels:].any()


@pytest.mark.parametrize("octave", [-1, 3])
def test_an_image_has_no_octave_beyond_its_last(octave):
    with pytest.raises(ValueError, match="0..2"):
        smaller(random_features(0, (8, 12), 3), octave=octave)


@pytest.mark.slow
def test_more_room_changes_no_octave(weights, photos):
    features = of(weights, photos[1][:192, :256], octaves=3, centred=True)
    wide = pad_features(features, 4 * features.coarse[0].shape[0])
    near, far = join(features), join(wide)
    np.testing.assert_array_equal(far.coarse[: len(near.coarse)], near.coarse)
    np.testing.assert_array_equal(far.fine[: len(near.fine)], near.fine)
    assert not np.asarray(far.coarse[len(near.coarse) :]).any()


@pytest.mark.slow
def test_the_smallest_image_has_octaves_without_cells(weights, photos):
    features = of(weights, photos[0][:48, :50], octaves=4, centred=True)
    joined = np.asarray(join(features).coarse)
    assert np.isfinite(joined).all() and joined[:9].any(1).all() and not joined[9:].any()


@pytest.mark.slow
def test_centred_descriptors_have_no_common_part(weights, photos):
    plain = of(weights, photos[3][:384, :512])
    centred = of(weights, photos[3][:384, :512], centred=True)
    n = 24 * 32
    x = np.asarray(plain.coarse[0])[:n]
    rest = x - x.mean(0)
    expected = rest / np.linalg.norm(rest, axis=1, keepdims=True)
    np.testing.assert_allclose(np.asarray(centred.coarse[0])[:n], expected, **tolerances.FEATURES)
    common = np.linalg.norm(np.asarray(centred.coarse[0])[:n].mean(0))
    assert common < 0.5 * np.linalg.norm(x.mean(0))


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_image_has_nothing_to_centre(weights, level):
    features = of(weights, np.full((320, 320, 3), level, np.uint8), centred=True)
    inner = np.asarray(features.coarse[0])[:400].reshape(20, 20, -1)[7:-7, 7:-7]
    edge = np.asarray(of(weights, np.full((320, 320, 3), level, np.uint8)).coarse[0])
    spread = np.ptp(edge[:400].reshape(20, 20, -1)[7:-7, 7:-7], axis=(0, 1)).max()
    assert spread < 1e-5  # all cells away from the border are alike
    assert len(np.unique(np.round(inner.reshape(-1, 512), 3), axis=0)) == 1


def test_presets_extract_what_they_say():
    assert preset("paper").extraction() == Config()
    assert preset("default").extraction().octaves == 4
    assert preset("robust").extraction().enlarge == 2.0
