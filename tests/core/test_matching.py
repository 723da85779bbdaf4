"""Laws of mutual nearest neighbours."""

import jax
import numpy as np
import oracles
import pytest
from compiled import compiled
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import rng_of, seeds, unit_rows
from tolerances import NEAR_TIE

from jaxsfm.core.matching import mutual_nn

SHAPES = [(1, 1), (7, 5), (33, 40)]
match = compiled(mutual_nn, "tile")


def descriptors(seed: int, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Two sets with true partners, strangers and zero rows."""
    rng = rng_of(seed)
    n, m = shape
    a, b = unit_rows(rng, n, 8), unit_rows(rng, m, 8)
    common = min(n, m) // 2
    b[:common] = a[rng.permutation(n)[:common]]
    a[rng.random(n) < 0.1] = 0
    b[rng.random(m) < 0.1] = 0
    return a, b


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from(SHAPES), st.sampled_from([4, 16, 64]))
def test_tiled_search_equals_brute_force(seed, shape, tile):
    a, b = descriptors(seed, shape)
    expected, margin = oracles.mutual_nn(a, b)
    decided = margin > NEAR_TIE
    np.testing.assert_array_equal(match(a, b, tile=tile)[decided], expected[decided])
    assert decided.mean() >= 0.7


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from(SHAPES))
def test_swapping_the_images_swaps_the_matches(seed, shape):
    a, b = descriptors(seed, shape)
    forward, backward = match(a, b), match(b, a)
    for i, j in enumerate(forward):
        assert j < 0 or backward[j] == i
    assert (forward >= 0).sum() == (backward >= 0).sum()


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_the_tile_size_changes_nothing(seed):
    a, b = descriptors(seed, (33, 40))
    np.testing.assert_array_equal(match(a, b, tile=5), match(a, b, tile=33))


def test_a_set_matches_itself():
    a = unit_rows(rng_of(0), 33, 8)
    np.testing.assert_array_equal(match(a, a), np.arange(33))


def test_zero_rows_never_match():
    a = unit_rows(rng_of(0), 7, 8)
    zero = np.zeros_like(a)
    assert (match(zero, a) == -1).all()
    assert (match(a, zero) == -1).all()
    assert (match(zero, zero) == -1).all()


def test_ties_go_to_the_lowest_index_across_tiles():
    a = np.zeros((6, 4), np.float32)
    a[:, 0] = 1
    np.testing.assert_array_equal(match(a, a, tile=2), [0, -1, -1, -1, -1, -1])


@pytest.mark.parametrize("shape", SHAPES)
def test_vmap_equals_loop(shape):
    sets = [descriptors(seed, shape) for seed in range(3)]
    a, b = map(np.stack, zip(*sets, strict=True))
    loop = [match(x, y) for x, y in sets]
    np.testing.assert_array_equal(compiled(jax.vmap(mutual_nn))(a, b), loop)
