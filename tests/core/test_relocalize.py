"""Laws of keypoint relocalization."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from compiled import compiled
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import rng_of, seeds

from jaxsfm.core.numerics import squared_norm
from jaxsfm.core.relocalize import (
    expectation,
    relocalize,
    window_positions,
)
from jaxsfm.core.relocalize import walk as random_walk

ROWS, COLS = 3, 5
LEAST = 1e-3
"""The score that is added to every pixel of a soft walk (docs/decisions/relocalization.md)."""


def random_maps(seed: int, *, ties: bool = False) -> list[np.ndarray]:
    rng = rng_of(seed)
    maps = []
    for level in (1, 2, 3):
        shape = (ROWS * 2**level, COLS * 2**level, 4)
        x = rng.integers(0, 2, shape) if ties else rng.normal(size=shape)
        maps.append(x.astype(np.float32))
    return maps


def cells() -> tuple[np.ndarray, np.ndarray]:
    row, col = np.mgrid[:ROWS, :COLS]
    return row.ravel().astype(np.int32), col.ravel().astype(np.int32)


ends = jax.jit(relocalize, static_argnames=("children", "variant"))


def _walk(maps, row, col, children=2, variant="hard", temperature=1.0):
    scores = [squared_norm(m) for m in maps]
    return relocalize(scores, row, col, variant=variant, temperature=temperature, children=children)


walk = compiled(_walk, "children", "variant")


def distinct_scores(seed: int) -> list[jnp.ndarray]:
    """Maps whose values differ by a hundredth at least."""
    rng = rng_of(seed)
    maps = random_maps(seed)
    return [
        jnp.asarray(rng.permutation(1.01 ** np.arange(m[..., 0].size)).reshape(m.shape[:2])).astype(
            jnp.float32
        )
        for m in maps
    ]


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_every_cell_ends_where_a_plain_loop_ends(seed):
    for ties in (False, True):  # equal norms: the first child wins
        maps = random_maps(seed, ties=ties)
        row, col = cells()
        for k, levels in ((2, 3), (4, 3), (6, 3), (2, 1), (4, 2)):
            some = maps[:levels]
            expected = [oracles.relocalize(some, r, c, k) for r, c in zip(row, col, strict=True)]
            np.testing.assert_array_equal(walk(some, row, col, children=k), expected)


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(seeds, st.sampled_from([2, 4]), st.sampled_from([1, 2, 3]), st.floats(0.3, 2.0))
def test_random_walks_end_where_all_paths_end(seed, k, levels, temperature):
    scores = [squared_norm(jnp.asarray(m)) for m in random_maps(seed)[:levels]]
    row, col = cells()
    walked = jax.jit(random_walk, static_argnames="children")
    window = walked(scores, jnp.asarray(row), jnp.asarray(col), temperature=temperature, children=k)
    places, p = np.asarray(window_positions(window)), np.asarray(window.p).reshape(len(row), -1)
    mean = np.asarray(expectation(window))
    for m in range(len(row)):
        args = (int(row[m]), int(col[m]), temperature, k, LEAST)
        expected = oracles.random_walk([np.asarray(s) for s in scores], *args)
        for place, probability in zip(places[m].astype(int), p[m], strict=True):
            assert abs(expected.get(tuple(place), 0.0) - probability) < 1e-5
        centre = sum(q * np.asarray(xy, float) for xy, q in expected.items())
        np.testing.assert_allclose(mean[m], centre, atol=1e-3)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(seeds, st.sampled_from([2, 4]))
def test_the_soft_walk_becomes_the_hard_one_as_it_cools(seed, k):
    scores = distinct_scores(seed)
    row, col = map(jnp.asarray, cells())
    hard = ends(scores, row, col, children=k)
    soft = [
        ends(scores, row, col, variant="soft", temperature=t, children=k)
        for t in (1.0, 1e-4, 1e-37)
    ]
    apart = [float(jnp.abs(xy - hard).max()) for xy in soft]
    assert apart[0] > 1e-4 > apart[1] and apart[2] == 0


@functools.partial(jax.jit, static_argnames="variant")
@jax.grad
def slopes_of(scores, row, col, variant):
    xy = relocalize(scores, row, col, variant=variant, temperature=0.5)
    return jnp.sum(jnp.sin(jnp.arange(xy.size, dtype=jnp.float32)) * xy.reshape(-1))


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(seeds)
def test_straight_through_has_the_hard_value_and_the_soft_gradient(seed):
    scores = distinct_scores(seed)
    row, col = map(jnp.asarray, cells())

    np.testing.assert_array_equal(
        ends(scores, row, col, variant="straight-through"), ends(scores, row, col)
    )
    through, soft = (slopes_of(scores, row, col, v) for v in ("straight-through", "soft"))
    for a, b in zip(through, soft, strict=True):
        np.testing.assert_array_equal(a, b)
    assert max(float(jnp.abs(g).max()) for g in soft) > 0


def weighted_ends(maps, children):
    """A sum of the soft walks' coordinates with weights of its own."""
    scores = [squared_norm(m) for m in maps]
    row, col = (jnp.asarray(x) for x in cells())
    xy = relocalize(scores, row, col, variant="soft", temperature=0.7, children=children)
    return jnp.sum(rng_of(1).normal(size=(len(row), 2)) * xy)


# Compiled once for all kinds of maps: four children compile for ten seconds.
slopes = jax.jit(jax.grad(weighted_ends), static_argnames="children")
weighted_ends = jax.jit(weighted_ends, static_argnames="children")


@pytest.mark.slow
@pytest.mark.parametrize("k", [2, 4])
@pytest.mark.parametrize("kind", ["random", "zero", "ties", "one pixel"])
def test_gradients_are_finite_and_those_of_central_differences(kind, k):
    """In float64, so that differences tell: through squared norms of features down to zeros."""
    with jax.enable_x64(True):
        maps = [m.astype(np.float64) for m in random_maps(3, ties=kind == "ties")]
        if kind in ("zero", "one pixel"):
            maps = [np.zeros_like(m) for m in maps]
        if kind == "one pixel":
            for m in maps:
                m[1, 1, 0] = 1.0
        maps = [jnp.asarray(m) for m in maps]
        gradient = slopes(maps, children=k)
        assert all(bool(jnp.isfinite(g).all()) for g in gradient)
        for seed in range(3):
            rng = rng_of(seed)
            way = [jnp.asarray(rng.normal(size=m.shape)) for m in maps]
            step = 1e-6

            def moved(sign, way=way, step=step):
                there = [m + sign * step * w for m, w in zip(maps, way, strict=True)]
                return weighted_ends(there, children=k)

            difference = (moved(1) - moved(-1)) / (2 * step)
            slope = sum(jnp.sum(g * w) for g, w in zip(gradient, way, strict=True))
            np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-6)


def test_scores_of_zero_walk_softly_to_the_middle_of_the_cell():
    maps = [np.zeros_like(m) for m in random_maps(0)]
    row, col = cells()
    xy = walk(maps, row, col, variant="soft")
    np.testing.assert_allclose(xy, np.stack([8 * col + 3.5, 8 * row + 3.5], axis=1), atol=1e-5)


def test_what_cannot_be_walked_is_refused():
    scores = [jnp.asarray(np.ones((2 * 2**k, 2 * 2**k), np.float32)) for k in range(3)]
    row = col = jnp.asarray(np.zeros((1,), np.int32))
    for wrong, words in (
        ({"scores": []}, "at least one level"),
        ({"scores": scores[::2]}, "twice the size"),
        ({"children": 3}, "even"),
        ({"children": 0}, "at least 2"),
        ({"variant": "soft", "temperature": 0.0}, "temperature must be positive"),
    ):
        given = {"scores": scores, "row": row, "col": col} | wrong
        with pytest.raises(ValueError, match=words):
            relocalize(given.pop("scores"), given.pop("row"), given.pop("col"), **given)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_keypoints_stay_in_their_cell_and_never_coincide(seed):
    row, col = cells()
    xy = walk(random_maps(seed), row, col).astype(int)
    np.testing.assert_array_equal(xy // 8, np.stack([col, row], axis=1))
    assert len({tuple(p) for p in xy}) == len(xy)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_a_common_gain_moves_nothing(seed):
    maps = random_maps(seed)
    row, col = cells()
    brighter = [2.0 * m for m in maps]
    np.testing.assert_array_equal(walk(maps, row, col), walk(brighter, row, col))


def test_jit_equals_eager_and_vmap_equals_loop():
    maps = [random_maps(seed) for seed in range(3)]
    row, col = cells()
    loop = [walk(m, row, col) for m in maps]
    eager = [jax.tree.map(jnp.asarray, x) for x in (maps[0], row, col)]
    np.testing.assert_array_equal(loop[0], _walk(*eager))
    stacked = [np.stack([m[level] for m in maps]) for level in range(3)]
    np.testing.assert_array_equal(
        compiled(jax.vmap(_walk, in_axes=(0, None, None)))(stacked, row, col),
        np.stack(loop),
    )


def test_a_zero_map_gives_the_top_left_pixel_of_every_cell():
    maps = [np.zeros_like(m) for m in random_maps(0)]
    row, col = cells()
    np.testing.assert_array_equal(walk(maps, row, col), np.stack([8 * col, 8 * row], axis=1))
