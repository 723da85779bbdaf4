"""Laws of neighbourhood consensus."""

import jax
import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import random_features, rng_of, seeds, unit_rows
from tolerances import NEAR_TIE

from jaxsfm.core.consensus import consensus_nn, weights
from jaxsfm.core.matching import mutual_nn
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.types import DescriptorGrid

join = jax.jit(join_octaves)
_match = jax.jit(consensus_nn, static_argnames=("radius", "columns", "tile"))


def match(a, b, grid0, grid1, *, parts=(), columns: int = 16, **kwargs):
    cells = DescriptorGrid(a, grid0, parts), DescriptorGrid(b, grid1)
    return _match(*cells, columns=columns, **kwargs)


def padded(x: np.ndarray, rows: int) -> np.ndarray:
    return np.pad(x, ((0, rows - len(x)), (0, 0)))


def grids(seed: int, shape0, shape1, *, room: int = 60):
    """Two grids of descriptors; the second repeats a part of the first, some cells are blank."""
    rng = rng_of(seed)
    maps = [unit_rows(rng, h * w, 8).reshape(h, w, 8) for h, w in (shape0, shape1)]
    h, w = (max(min(x, y) - 1, 1) for x, y in zip(shape0, shape1, strict=True))
    maps[1][-h:, -w:] = maps[0][:h, :w]
    flat = [m.reshape(-1, 8) * (rng.random((m.shape[0] * m.shape[1], 1)) > 0.1) for m in maps]
    sizes = [np.asarray(s, np.int32) for s in (shape0, shape1)]
    return [padded(np.float32(x), room) for x in flat], sizes


KERNELS = {
    1: [0.606531, 1.0, 0.606531],
    2: [0.606531, 0.882497, 1.0, 0.882497, 0.606531],
}
"""exp(-d^2 / (2 r^2)): a Gaussian whose deviation is the radius."""
SHAPES = [((5, 7), (6, 6)), ((1, 1), (3, 4)), ((7, 2), (2, 9)), ((4, 9), (4, 9))]


@pytest.mark.parametrize("radius", [1, 2])
def test_the_kernel_is_a_gaussian_as_wide_as_the_radius(radius):
    np.testing.assert_allclose(weights(radius), KERNELS[radius], rtol=1e-5)


@pytest.mark.parametrize("sizes", [{"radius": 0, "columns": 16}, {"radius": 1, "columns": 0}])
def test_a_radius_or_a_width_of_nothing_is_refused(sizes):
    (a, b), grids_ = grids(0, (5, 7), (6, 6))
    with pytest.raises(ValueError, match="at least 1; got"):
        match(a, b, *grids_, **sizes)


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from(SHAPES), st.sampled_from([1, 2]), st.sampled_from([7, 16, 60]))
def test_tiled_consensus_equals_the_sum_over_shifts(seed, shapes, radius, tile):
    (a, b), (grid0, grid1) = grids(seed, *shapes)
    expected, margin = oracles.consensus_nn(a, b, grid0, grid1, KERNELS[radius])
    decided = margin > NEAR_TIE
    got = np.asarray(match(a, b, grid0, grid1, radius=radius, tile=tile))
    np.testing.assert_array_equal(got[decided], expected[decided])
    assert decided.mean() >= 0.7


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(seeds, st.sampled_from(SHAPES), st.sampled_from([7, 60]), st.sampled_from([2, 4]))
def test_products_of_octaves_are_blends_of_their_cells_products(seed, shapes, tile, octaves):
    joined = [join(random_features(seed + k, shape, octaves)) for k, shape in enumerate(shapes)]
    a, b = (np.asarray(x.coarse) for x in joined)
    grid0, grid1 = (x.coarse_grid for x in joined)
    expected, margin = oracles.consensus_nn(a, b, grid0, grid1, KERNELS[1])
    decided = margin > NEAR_TIE
    parts = joined[0].coarse_parts
    got = match(a, b, grid0, grid1, parts=parts, radius=1, tile=tile)
    np.testing.assert_array_equal(np.asarray(got)[decided], expected[decided])
    assert decided.mean() >= 0.7


@settings(max_examples=20, deadline=None)
@given(seeds, st.sampled_from(SHAPES))
def test_swapping_the_images_swaps_the_matches(seed, shapes):
    (a, b), (grid0, grid1) = grids(seed, *shapes)
    forward = np.asarray(match(a, b, grid0, grid1, radius=1))
    backward = np.asarray(match(b, a, grid1, grid0, radius=1))
    for i, j in enumerate(forward):
        assert j < 0 or backward[j] == i
    assert (forward >= 0).sum() == (backward >= 0).sum()


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_room_for_more_cells_changes_nothing(seed):
    (a, b), sizes = grids(seed, (5, 7), (6, 6))
    got = np.asarray(match(a, b, *sizes, radius=1))
    wide = np.asarray(match(padded(a, 80), padded(b, 80), *sizes, radius=1))
    np.testing.assert_array_equal(wide[:60], got)
    assert (wide[35:] == -1).all() and (got[35:] == -1).all()


def test_blank_cells_never_match():
    (a, b), sizes = grids(0, (5, 7), (6, 6))
    got = np.asarray(match(a, b, *sizes, radius=1))
    assert (got[~a.any(1)] == -1).all() and not np.isin(np.flatnonzero(~b.any(1)), got).any()
    assert (np.asarray(match(np.zeros_like(a), b, *sizes, radius=1)) == -1).all()


def test_an_image_matches_itself():
    rng = rng_of(2)
    a = padded(unit_rows(rng, 42, 8), 60)
    grid = np.asarray([6, 7], np.int32)
    np.testing.assert_array_equal(match(a, a, grid, grid, radius=1)[:42], np.arange(42))


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_find_what_noise_hides(seed):
    """A shifted grid under noise that defeats single cells."""
    rng = rng_of(seed)
    scene = rng.normal(size=(14, 16, 8))
    views = [scene[:12, :14], scene[2:, 2:]]
    sizes = [np.asarray([12, 14], np.int32)] * 2
    flat = []
    for view in views:
        noisy = view + 0.8 * rng.normal(size=view.shape)
        flat.append(np.float32(noisy / np.linalg.norm(noisy, axis=-1, keepdims=True)))
    a, b = (x.reshape(-1, 8) for x in flat)
    cell = np.arange(168)
    row, column = cell // 14 - 2, cell % 14 - 2
    truth = np.where((row >= 0) & (column >= 0), row * 14 + column, -2)
    alone = (np.asarray(jax.jit(mutual_nn)(a, b)) == truth).sum()
    together = (np.asarray(match(a, b, *sizes, radius=1)) == truth).sum()
    assert together > 1.5 * alone and together > 0.7 * (truth >= 0).sum()


def test_a_grid_wider_than_said_has_no_matches():
    (a, b), sizes = grids(0, (5, 7), (6, 6))
    assert (np.asarray(match(a, b, *sizes, radius=1, columns=6)) == -1).all()
    assert (np.asarray(match(a, b, *sizes, radius=1, columns=7)) >= 0).any()
