"""Laws of keypoint relocalization."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
from hypothesis import given, settings
from strategies import rng_of, seeds

from jaxsfm.core.numerics import squared_norm
from jaxsfm.core.relocalize import flat_pyramid, relocalize

ROWS, COLS = 3, 5


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


@jax.jit
def walk(maps, row, col):
    norms, levels = flat_pyramid([squared_norm(jnp.asarray(m)) for m in maps])
    return relocalize(norms, levels, jnp.asarray(row), jnp.asarray(col))


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_every_cell_ends_where_a_plain_loop_ends(seed):
    for ties in (False, True):  # equal norms: the first child wins
        maps = random_maps(seed, ties=ties)
        row, col = cells()
        expected = [oracles.relocalize(maps, r, c) for r, c in zip(row, col, strict=True)]
        np.testing.assert_array_equal(np.asarray(walk(maps, row, col)), expected)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_keypoints_stay_in_their_cell_and_never_coincide(seed):
    row, col = cells()
    xy = np.asarray(walk(random_maps(seed), row, col)).astype(int)
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
    np.testing.assert_array_equal(loop[0], walk.__wrapped__(maps[0], row, col))
    stacked = [np.stack([m[level] for m in maps]) for level in range(3)]
    np.testing.assert_array_equal(
        jax.vmap(walk, in_axes=(0, None, None))(stacked, jnp.asarray(row), jnp.asarray(col)),
        np.stack(loop),
    )


def test_a_zero_map_gives_the_top_left_pixel_of_every_cell():
    maps = [np.zeros_like(m) for m in random_maps(0)]
    row, col = cells()
    np.testing.assert_array_equal(walk(maps, row, col), np.stack([8 * col, 8 * row], axis=1))
