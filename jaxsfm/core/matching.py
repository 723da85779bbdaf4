"""Mutual nearest neighbours of unit descriptors, tiled: no full n x m matrix has to exist."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsfm.core.numerics import HIGHEST, argmax_first


def similarity(a: Float[Array, "n c"], b: Float[Array, "m c"]) -> Float[Array, "n m"]:
    """Inner products; -inf where either descriptor is zero (padding, or nothing to see).

    For unit vectors |a - b|^2 = 2 - 2 a.b, so the largest product is the nearest neighbour.
    """
    products = jnp.einsum("nc,mc->nm", a, b, precision=HIGHEST)
    a_set, b_set = jnp.any(a != 0, axis=-1), jnp.any(b != 0, axis=-1)
    return jnp.where(a_set[:, None] & b_set[None, :], products, -jnp.inf)


def mutual(
    row_best: Int[Array, " n"],
    row_score: Float[Array, " n"],
    col_best: Int[Array, " m"],
) -> Int[Array, " n"]:
    """The column of each row where both choose each other, else -1."""
    rows = jnp.arange(row_best.shape[0], dtype=jnp.int32)
    agreed = (jnp.take(col_best, row_best, mode="clip") == rows) & jnp.isfinite(row_score)
    return jnp.where(agreed, row_best, -1)


def mutual_nn(
    a: Float[Array, "n c"], b: Float[Array, "m c"], *, tile: int = 1024
) -> Int[Array, " n"]:
    """For every row of `a` the row of `b` that is its mutual nearest neighbour, or -1.

    Exact; ties go to the lowest index on both sides. No ratio test: neighbouring cells look alike
    (paper, section 3.1). `tile` rows of the similarity matrix exist at a time.
    """
    n, m = a.shape[0], b.shape[0]
    tile = min(tile, n)
    num_tiles = -(-n // tile)
    tiles = jnp.pad(a, ((0, num_tiles * tile - n), (0, 0))).reshape(num_tiles, tile, -1)

    def step(best, item):
        col_score, col_best = best
        start, rows = item
        s = similarity(rows, b)
        row_score, row_best = argmax_first(s, axis=1)
        score, index = argmax_first(s, axis=0)
        better = score > col_score
        return (
            jnp.where(better, score, col_score),
            jnp.where(better, index + start, col_best),
        ), (row_best, row_score)

    start = (jnp.full((m,), -jnp.inf, a.dtype), jnp.zeros((m,), jnp.int32))
    starts = jnp.arange(num_tiles, dtype=jnp.int32) * tile
    (_, col_best), (row_best, row_score) = lax.scan(step, start, (starts, tiles))
    return mutual(row_best.reshape(-1)[:n], row_score.reshape(-1)[:n], col_best)
