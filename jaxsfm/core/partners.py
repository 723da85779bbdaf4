"""Which photos are matched with each photo, by the products of their global descriptors."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.numerics import HIGHEST

TIE = 1e-5
"""Products of global descriptors that differ by less count as equal, so that rounding does not
order them."""


def partners(
    x: Float[Array, "n c"], *, k: int, candidates: int, block: int = 256
) -> Int[Array, "n k"]:
    """For each row k other rows with large products, which differ from each other.

    The candidates of a row are the rows with the largest products with it. They are taken in this
    order, without those that have a larger product with a taken one than with the row itself. If
    fewer than k are left, the largest of the others follow. So k candidates are all partners. The
    lower index comes first among equals.

    In a video, the nearest rows are neighbours in time, and those are neighbours of each other.
    Source of the rule: Malkov and Yashunin, TPAMI 2020, algorithm 4 (there it keeps a graph of
    neighbours connected across clusters).

    Args:
      x: global descriptors of unit length.
      candidates: their number for each row. If there are fewer other rows, those are taken.
      block: so many rows of the table of products exist at a time.

    Raises:
      ValueError: there are fewer than k other rows, or fewer than k candidates.
    """
    n = x.shape[0]
    if not 1 <= k < n:
        raise ValueError(f"k must lie in 1..{n - 1}, the number of other rows; got {k}")
    if candidates < k:
        raise ValueError(f"candidates must be at least k = {k}; got {candidates}")
    candidates, block = min(candidates, n - 1), min(block, n)
    padded = jnp.pad(x, ((0, -n % block), (0, 0)))

    def rows(start):
        own = lax.dynamic_slice_in_dim(padded, start, block)
        products = jnp.round(jnp.matmul(own, x.T, precision=HIGHEST) / TIE)
        itself = start + jnp.arange(block, dtype=jnp.int32)
        others = itself[:, None] != jnp.arange(n, dtype=jnp.int32)
        return lax.top_k(jnp.where(others, products, -jnp.inf), candidates)

    def chosen(row):
        products, at = row
        near = x[at]
        mutual = jnp.round(jnp.matmul(near, near.T, precision=HIGHEST) / TIE)
        taken = _differing(products, mutual)
        return at[jnp.argsort(~taken, stable=True)[:k]]

    starts = jnp.arange(-(-n // block), dtype=jnp.int32) * block
    products, at = (each.reshape(-1, candidates)[:n] for each in lax.map(rows, starts))
    return lax.map(chosen, (products, at)).astype(jnp.int32)


def _differing(products: Float[Array, " m"], mutual: Float[Array, "m m"]) -> Bool[Array, " m"]:
    """The candidates that are not nearer to one that is taken before them than to the row itself.

    Args:
      products: of the candidates with the row, largest first.
      mutual: products of the candidates with each other.
    """

    def step(taken, each):
        i, product, others = each
        fits = ~jnp.any(taken & (others > product))
        return taken.at[i].set(fits), None

    ranks = jnp.arange(len(products), dtype=jnp.int32)
    none = jnp.zeros(len(products), bool)
    return lax.scan(step, none, (ranks, products, mutual))[0]
