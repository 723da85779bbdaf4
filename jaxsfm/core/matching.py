"""Mutual nearest neighbours of unit descriptors, in tiles, so that no n x m matrix has to exist."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsfm.core.numerics import argmax_first, descriptor_products


def similarity(a: Float[Array, "n c"], b: Float[Array, "m c"]) -> Float[Array, "n m"]:
    """Inner products; -inf where either descriptor is zero (padding, or a cell that shows nothing).

    For unit vectors |a - b|^2 = 2 - 2 a.b, so the largest product is the nearest neighbour.
    """
    products = descriptor_products("nc,mc->nm", a, b)
    a_set, b_set = jnp.any(a != 0, axis=-1), jnp.any(b != 0, axis=-1)
    return jnp.where(a_set[:, None] & b_set[None, :], products, -jnp.inf)


def mutual(
    row_best: Int[Array, " n"],
    row_score: Float[Array, " n"],
    col_best: Int[Array, " m"],
) -> Int[Array, " n"]:
    """For each row the column that it chose, if that column chose the row; otherwise -1."""
    rows = jnp.arange(row_best.shape[0], dtype=jnp.int32)
    agreed = (jnp.take(col_best, row_best, mode="clip") == rows) & jnp.isfinite(row_score)
    return jnp.where(agreed, row_best, -1)


def scan_mutual(
    scores: Callable[[Array], Float[Array, "tile m"]], n: int, m: int, *, tile: int
) -> Int[Array, " n"]:
    """Mutual best partners of n rows and m columns; `tile` rows of scores exist at a time.

    The result is exact, and ties go to the lowest index on both sides.

    Args:
      scores: a function of the first row (int32) that returns the scores of `tile` rows; -inf for
        pairs that cannot match and for rows after the last one.
    """

    def step(best, start):
        col_score, col_best = best
        s = scores(start)
        row_score, row_best = argmax_first(s, axis=1)
        score, index = argmax_first(s, axis=0)
        better = score > col_score
        return (
            jnp.where(better, score, col_score),
            jnp.where(better, index + start, col_best),
        ), (row_best, row_score)

    begin = (
        jnp.full((m,), -jnp.inf, jax.eval_shape(scores, jnp.int32(0)).dtype),
        jnp.zeros((m,), jnp.int32),
    )
    starts = jnp.arange(-(-n // tile), dtype=jnp.int32) * tile
    (_, col_best), (row_best, row_score) = lax.scan(step, begin, starts)
    return mutual(row_best.reshape(-1)[:n], row_score.reshape(-1)[:n], col_best)


def mutual_nn(
    a: Float[Array, "n c"], b: Float[Array, "m c"], *, tile: int = 1024
) -> Int[Array, " n"]:
    """For every row of `a` the row of `b` that is its mutual nearest neighbour, or -1.

    The result is exact, and ties go to the lowest index on both sides. There is no ratio test,
    because neighbouring cells look alike (paper, section 3.1). `tile` rows of the similarity matrix
    exist at a time.
    """
    n = a.shape[0]
    tile = min(tile, n)
    padded = jnp.pad(a, ((0, -n % tile), (0, 0)))

    def scores(start):
        return similarity(lax.dynamic_slice_in_dim(padded, start, tile), b)

    return scan_mutual(scores, n, b.shape[0], tile=tile)
