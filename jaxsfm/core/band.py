"""Symmetric systems whose matrix is a band: tiles on the diagonal, and each beside the next one.

A row of photos has such a system if its photos are in the right order, because only photos near
each other have common points. Its factor costs as much for each photo as the square of the band's
width, and not of the number of photos.

Source: Golub and Van Loan 2013, "Matrix computations", section 4.5 (block tridiagonal systems).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsfm.core.numerics import HIGHEST


class BandFactor(NamedTuple):
    """A = L L^T, where L has tiles on the diagonal and below it."""

    lower: Float[Array, "t s s"]
    """Lower triangles; not finite from the first tile on that has none."""
    beside: Float[Array, "t s s"]
    """The transposes of the tiles below them."""


def band_factor(diagonal: Float[Array, "t s s"], beside: Float[Array, "t s s"]) -> BandFactor:
    """The factor of a matrix.

    Args:
      beside: the tile to the right of each of the diagonal; that of the last one does not count.
    """

    def step(last, tiles):
        own, right = tiles
        known = jnp.einsum("ki,kj->ij", last, last, precision=HIGHEST)
        lower = lax.linalg.cholesky(own - known)
        right = lax.linalg.triangular_solve(lower, right, left_side=True, lower=True)
        return right, (lower, right)

    return BandFactor(*lax.scan(step, jnp.zeros_like(diagonal[0]), (diagonal, beside))[1])


def band_solve(factor: BandFactor, right: Float[Array, "t s"]) -> Float[Array, "t s"]:
    """The solution for a right side."""

    def solved(lower, x, *, transposed):
        how = {"left_side": True, "lower": True, "transpose_a": transposed}
        return lax.linalg.triangular_solve(lower, x[:, None], **how)[:, 0]

    def down(before, tiles):
        lower, beside, own = tiles
        x = solved(lower, own - before, transposed=False)
        return jnp.einsum("ij,i->j", beside, x, precision=HIGHEST), x

    def up(after, tiles):
        lower, beside, own = tiles
        own = own - jnp.einsum("ij,j->i", beside, after, precision=HIGHEST)
        x = solved(lower, own, transposed=True)
        return x, x

    nothing = jnp.zeros_like(right[0])
    half = lax.scan(down, nothing, (*factor, right))[1]
    return lax.scan(up, nothing, (*factor, half), reverse=True)[1]
