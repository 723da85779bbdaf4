"""Neighbourhood consensus: a match counts for more where its neighbours match alike.

    S'(i, j) = sum over shifts d of w(d) S(i + d, j + d),  w(d) = exp(-|d|^2 / (2 r^2))

with S the similarity of coarse cells i and j, the same shift d in both images, both parts of d from
-r to r. Nothing is learnt; what lies outside either image adds nothing. The idea is that of learnt
consensus networks (Rocco et al. 2018, "Neighbourhood Consensus Networks"), with one fixed kernel.
"""

import math

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsfm.core.grid import cell_rows_cols
from jaxsfm.core.matching import scan_mutual
from jaxsfm.core.numerics import HIGHEST


def weights(radius: int) -> list[float]:
    """The kernel along one axis; the plane's is their product."""
    return [math.exp(-(d * d) / (2 * radius * radius)) for d in range(-radius, radius + 1)]


def stack_rows(
    x: Float[Array, "n c"], grid: Int[Array, " 2"], *, radius: int
) -> Float[Array, "n k"]:
    """Each cell's descriptor beside those above and below it, times the roots of their weights.

    Products of such stacks are sums over shifts by whole rows.
    """
    cell = jnp.arange(x.shape[0], dtype=jnp.int32)
    parts = []
    for d, w in zip(range(-radius, radius + 1), weights(radius), strict=True):
        other = cell + d * grid[1]
        there = (cell < grid[0] * grid[1]) & (other >= 0) & (other < grid[0] * grid[1])
        shifted = jnp.take(x, jnp.where(there, other, 0), axis=0)
        parts.append(jnp.where(there[:, None], math.sqrt(w) * shifted, 0.0))
    return jnp.concatenate(parts, axis=1)


def consensus_nn(
    a: Float[Array, "n c"],
    b: Float[Array, "m c"],
    grid0: Int[Array, " 2"],
    grid1: Int[Array, " 2"],
    *,
    radius: int,
    tile: int = 1024,
) -> Int[Array, " n"]:
    """For every cell of image 0 its mutual best cell of image 1 under S', or -1.

    Exact; ties go to the lowest index on both sides; a zero descriptor never matches. `tile` rows
    of S' exist at a time. Costs 2 radius + 1 times the products of `mutual_nn`: shifts by rows
    are stacked descriptors, shifts by columns are shifts of the product itself.

    Args:
      a, b: unit descriptors, cell (row, column) at row * columns + column, zero past the grid.
      grid0, grid1: (rows, columns).
      radius: 1: 3 x 3 cells, 2: 5 x 5.

    Raises:
      ValueError: the radius is below 1.
    """
    if radius < 1:
        raise ValueError(f"radius must be at least 1; got {radius}")
    n, m = a.shape[0], b.shape[0]
    tile = min(tile, n)
    rows = jnp.pad(stack_rows(a, grid0, radius=radius), ((radius, -n % tile + radius), (0, 0)))
    columns = jnp.pad(stack_rows(b, grid1, radius=radius), ((radius, radius), (0, 0)))
    alive0 = jnp.pad(jnp.any(a != 0, axis=1), (0, -n % tile))
    alive1 = jnp.any(b != 0, axis=1)
    column0 = cell_rows_cols(n + -n % tile, grid0[1])[1]
    column1 = cell_rows_cols(m, grid1[1])[1]

    def scores(start):
        block = lax.dynamic_slice_in_dim(rows, start, tile + 2 * radius)
        product = jnp.einsum("nc,mc->nm", block, columns, precision=HIGHEST)
        at = lax.dynamic_slice_in_dim(column0, start, tile)
        total = jnp.zeros((tile, m), a.dtype)
        for k, (d, w) in enumerate(zip(range(-radius, radius + 1), weights(radius), strict=True)):
            # The cell before a row's first one is the last of another row: not a neighbour.
            inside0 = (at + d >= 0) & (at + d < grid0[1])
            inside1 = (column1 + d >= 0) & (column1 + d < grid1[1])
            shifted = lax.slice(product, (k, k), (k + tile, k + m))
            total += jnp.where(inside0[:, None] & inside1[None, :], w * shifted, 0.0)
        alive = lax.dynamic_slice_in_dim(alive0, start, tile)
        return jnp.where(alive[:, None] & alive1[None, :], total, -jnp.inf)

    return scan_mutual(scores, n, m, tile=tile)
