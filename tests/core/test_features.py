"""Laws of an image's features, from maps that need no network."""

import jax
import numpy as np
import oracles
import pytest
import tolerances
from compiled import compiled
from strategies import rng_of

from jaxsfm.core import features as core
from jaxsfm.core.features import Walk
from jaxsfm.core.types import Levels

dense_features = compiled(
    core.dense_features, "num_coarse", "num_fine", "fine_stride", "centred", "walk"
)
SIZE = (35, 50)
"""Valid rows and columns, in maps of 48 x 64: 4 x 6 fine and 2 x 3 coarse cells."""
NUM_COARSE, NUM_FINE = 9, 40


def levels(rng, size=(48, 64)) -> Levels:
    h, w = size

    def map_of(stride, *channels):
        return np.float32(rng.normal(size=(1, h // stride, w // stride, *channels)))

    scores = tuple(map_of(stride) ** 2 for stride in (1, 2, 4))
    return Levels(scores, map_of(8, 5), map_of(16, 7))


def features(octaves, **options):
    return dense_features(
        octaves, np.int32(SIZE), num_coarse=NUM_COARSE, num_fine=NUM_FINE, **options
    )


def units(feature_map, rows, cols, *, centred=False) -> np.ndarray:
    """The valid cells' unit descriptors, row by row, one after the other."""
    flat = [oracles.length_one(feature_map[r, c]) for r in range(rows) for c in range(cols)]
    if centred:
        live = [x for x in flat if x.any()]
        mean = np.sum(live, axis=0) / len(live)
        flat = [oracles.length_one(x - mean) if x.any() else x for x in flat]
    return np.asarray(flat)


@pytest.mark.parametrize("centred", [False, True])
def test_descriptors_are_the_maps_valid_cells_in_row_order(centred):
    rng = rng_of(0)
    first, half = levels(rng), levels(rng, (32, 32))
    first.pool3[0, 1, 2] = 0
    found = features([first, half], centred=centred)
    np.testing.assert_array_equal(found.fine_grid, [4, 6])
    np.testing.assert_array_equal(found.coarse_grid, [2, 3])
    for ours, octave, grid, capacity in (
        (found.fine[0], first.pool3, (4, 6), 40),
        (found.fine[1], half.pool3, (2, 3), 10),
        (found.coarse[0], first.pool4, (2, 3), 9),
        (found.coarse[1], half.pool4, (1, 1), 3),
    ):
        expected = units(octave[0].astype(np.float64), *grid, centred=centred)
        if centred and grid == (1, 1):
            expected[:] = 0  # a single cell does not differ from the mean
        assert ours.shape[0] == capacity
        np.testing.assert_allclose(ours[: len(expected)], expected, **tolerances.UNIT)
        assert not ours[len(expected) :].any()


def test_what_differs_from_the_mean_by_a_thousandth_shows_nothing():
    """Cells 0 and 1 are apart from the other twenty-two; those hardly differ from each other."""
    base = np.zeros((6, 8, 5), np.float32)
    base[..., 0] = 1
    base[0, 0, 1] = base[0, 1, 2] = 0.01
    maps = levels(rng_of(1))._replace(pool3=base[None])
    found = features([maps], centred=True).fine[0][:24]
    np.testing.assert_array_equal(found.any(1), np.arange(24) < 2)
    # With twenty times the difference the others are further from the mean than that.
    base[0, 0, 1] = base[0, 1, 2] = 0.2
    maps = maps._replace(pool3=base[None])
    assert features([maps], centred=True).fine[0][:24].any(1).all()


def test_keypoints_walk_or_stay_at_the_centres_and_padding_has_none():
    maps = levels(rng_of(2))
    walked = features([maps]).keypoints
    centres = features([maps], walk=Walk(levels=0)).keypoints
    scores = [np.sqrt(s[0])[..., None] for s in reversed(maps.scores)]
    for cell in range(24):
        row, col = divmod(cell, 6)
        np.testing.assert_array_equal(walked[cell], oracles.relocalize(scores, row, col))
        np.testing.assert_array_equal(centres[cell], [8 * col + 3.5, 8 * row + 3.5])
    assert not walked[24:].any() and not centres[24:].any()


@pytest.mark.parametrize("count", [0, 1, 2, 3])
@pytest.mark.parametrize("children", [2, 4])
def test_a_shorter_walk_ends_at_the_centre_of_a_cell(count, children):
    maps = levels(rng_of(5))
    found = features([maps], walk=Walk(count, children)).keypoints
    scores = [np.sqrt(s[0])[..., None] for s in reversed(maps.scores)][:count]
    stride = 8 >> count
    for cell in range(24):
        end = oracles.relocalize(scores, *divmod(cell, 6), children)
        np.testing.assert_array_equal(found[cell], [(at + 0.5) * stride - 0.5 for at in end])


def test_finer_cells_have_finer_grids():
    maps = levels(rng_of(6))
    wide = maps._replace(
        pool4=maps.pool3, pool3=np.ones((1, 12, 16, 4), np.float32), scores=maps.scores[:2]
    )
    found = dense_features([wide], np.int32(SIZE), num_coarse=24, num_fine=96, fine_stride=4)
    np.testing.assert_array_equal(found.fine_grid, [35 // 4, 50 // 4])
    np.testing.assert_array_equal(found.coarse_grid, [35 // 8, 50 // 8])
    cell = np.arange(8 * 12)
    own = np.stack([cell % 12, cell // 12], axis=1)
    np.testing.assert_array_equal(found.keypoints[: len(own)] // 4, own)


def test_an_image_without_a_coarse_cell_has_no_descriptors():
    found = dense_features(
        [levels(rng_of(3))],
        np.int32([9, 7]),
        num_coarse=NUM_COARSE,
        num_fine=NUM_FINE,
    )
    assert not found.fine[0].any() and not found.coarse[0].any()


def test_stored_features_are_half_as_large_and_hardly_moved():
    found = features([levels(rng_of(4))])
    small = compiled(core.stored)(found)
    for a, b in ((small.fine[0], found.fine[0]), (small.coarse[0], found.coarse[0])):
        assert a.dtype == np.float16
        assert np.linalg.norm(np.asarray(a, np.float32) - b, axis=1).max() < 5e-4
    rest = lambda f: f._replace(fine=(), coarse=())  # noqa: E731
    for a, b in zip(jax.tree.leaves(rest(small)), jax.tree.leaves(rest(found)), strict=True):
        np.testing.assert_array_equal(a, b)
