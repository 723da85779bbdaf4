"""From coarse (pool4) matches to fine (pool3) correspondences.

Around each mutual coarse match lie 3 x 3 coarse cells in either image, that is 6 x 6 fine cells.
The fine cells of these two windows are matched by mutual nearest neighbours inside the windows.
Windows overlap, so a fine cell may have several partners; repeated pairs are removed. The paper,
section 3.2, gives the principle, and the authors' code the details.

A fine cell lies in at most nine windows, centred on the 3 x 3 coarse cells around it, and each
coarse cell has at most one mutual match. So all partners of a cell fit into nine slots, which are
gathered without sorting pairs, without a scatter and without a data-dependent shape.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.grid import cell_rows_cols
from jaxsfm.core.matching import mutual
from jaxsfm.core.numerics import argmax_first, at_least_float32, compact, descriptor_products
from jaxsfm.core.types import JoinedFeatures

RADIUS = 1
"""Coarse cells on each side of the match: 3 x 3 windows."""
SIDE = 2 * (2 * RADIUS + 1)
"""Fine cells along a window."""
_WINDOW = tuple((r, c) for r in range(SIDE) for c in range(SIDE))
_CENTRES = tuple((dr, dc) for dr in range(-RADIUS, RADIUS + 1) for dc in range(-RADIUS, RADIUS + 1))


def window_cells(
    cell: Int[Array, " b"], coarse_grid: Int[Array, " 2"], fine_grid: Int[Array, " 2"]
) -> tuple[Int[Array, "b w"], Bool[Array, "b w"]]:
    """The fine cells of the window around each coarse cell, row by row, and which of them exist.

    The window is cut at the border of the coarse grid. Fine cells of an odd last row or column
    belong to no coarse cell and are not reached.
    """
    row, col = cell // coarse_grid[1], cell % coarse_grid[1]
    offset = jnp.asarray(_WINDOW, jnp.int32)
    rows = 2 * (row[:, None] - RADIUS) + offset[:, 0]
    cols = 2 * (col[:, None] - RADIUS) + offset[:, 1]
    inside = (rows >= 0) & (rows < 2 * coarse_grid[0]) & (cols >= 0) & (cols < 2 * coarse_grid[1])
    return jnp.where(inside, rows * fine_grid[1] + cols, 0), inside


def rows_of(table: Float[Array, "m d"], index: Int[Array, "*b"]) -> Float[Array, "*b d"]:
    """Rows of a table. Indices must be in range, which spares a check."""
    return jnp.take(table, index, axis=0, mode="clip")


def _match_windows(
    f0: JoinedFeatures,
    f1: JoinedFeatures,
    shown: tuple[Bool[Array, " m"], Bool[Array, " m"]],
    cell0: Int[Array, " b"],
    cell1: Int[Array, " b"],
) -> Int[Array, "b w"]:
    """The fine cell of image 1 for every window cell of image 0, or -1."""
    index0, inside0 = window_cells(cell0, f0.coarse_grid, f0.fine_grid)
    index1, inside1 = window_cells(cell1, f1.coarse_grid, f1.fine_grid)
    a, b = (rows_of(f.fine, index) for f, index in ((f0, index0), (f1, index1)))
    a_set, b_set = inside0 & shown[0][index0], inside1 & shown[1][index1]
    s = descriptor_products("bwd,bvd->bwv", a, b)
    s = jnp.where(a_set[:, :, None] & b_set[:, None, :], s, -jnp.inf)
    row_score, row_best = argmax_first(s, axis=2)
    _, col_best = argmax_first(s, axis=1)
    partner = jax.vmap(mutual)(row_best, row_score, col_best)
    return jnp.where(partner >= 0, jnp.take_along_axis(index1, jnp.maximum(partner, 0), axis=1), -1)


def match_windows(
    f0: JoinedFeatures, f1: JoinedFeatures, coarse: Int[Array, " n"], *, chunk: int = 16
) -> Int[Array, "n w"]:
    """`_match_windows` for every coarse match, `chunk` matches at a time; -1 where there is none.

    The loop ends with the last match, so unmatched cells cost nothing. The windows of 16 matches
    with 1024 channels take 5 MB and stay in the cache, which halves the time of 128 matches.
    """
    n = coarse.shape[0]
    shown = jnp.any(f0.fine != 0, axis=-1), jnp.any(f1.fine != 0, axis=-1)
    chunk = min(chunk, n)
    matched, count = compact(coarse >= 0, size=n)

    def body(state):
        i, table = state
        # The last chunk is moved back to fit. The rows that it repeats are written twice, alike.
        start = jnp.minimum(i * chunk, n - chunk)
        cell0 = lax.dynamic_slice(matched, (start,), (chunk,))
        live = start + jnp.arange(chunk, dtype=jnp.int32) < count
        cell1 = jnp.where(live, coarse[cell0], 0)
        rows = _match_windows(f0, f1, shown, cell0, cell1)
        target = jnp.where(live, cell0, n)
        return i + 1, table.at[target].set(rows, mode="drop")

    table = jnp.full((n, SIDE * SIDE), -1, jnp.int32)
    return lax.while_loop(lambda s: s[0] * chunk < count, body, (jnp.int32(0), table))[1]


def candidates(windows: Int[Array, "n w"], f0: JoinedFeatures) -> Int[Array, "m slots"]:
    """The different partners of every fine cell of image 0 in ascending order, followed by -1.

    Args:
      windows: from `match_windows`.
    """
    m, n = f0.fine.shape[0], windows.shape[0]
    row, col = cell_rows_cols(m, f0.fine_grid[1])
    slots = []
    for dr, dc in _CENTRES:
        r, c = row // 2 + dr, col // 2 + dc
        exists = (r >= 0) & (r < f0.coarse_grid[0]) & (c >= 0) & (c < f0.coarse_grid[1])
        exists &= (row < 2 * f0.coarse_grid[0]) & (col < 2 * f0.coarse_grid[1])
        centre = jnp.clip(r * f0.coarse_grid[1] + c, 0, n - 1)
        local = (row - 2 * (r - RADIUS)) * SIDE + (col - 2 * (c - RADIUS))
        slots.append(jnp.where(exists, windows[centre, local], -1))
    last = jnp.iinfo(jnp.int32).max
    table = jnp.stack(slots, axis=1)
    table = jnp.sort(jnp.where(table < 0, last, table), axis=1)
    repeated = jnp.concatenate([jnp.zeros((m, 1), bool), table[:, 1:] == table[:, :-1]], axis=1)
    return jnp.where(repeated | (table == last), -1, table)


def correspondences(
    table: Int[Array, "m slots"], *, capacity: int
) -> tuple[Int[Array, "capacity 2"], Int[Array, ""]]:
    """(cell 0, cell 1) of every candidate in index order, and the number of candidates.

    Candidates beyond `capacity` are cut off at the end, but they are counted.
    """
    slots = table.shape[1]
    index, count = compact(table.reshape(-1) >= 0, size=capacity)
    return jnp.stack([index // slots, table.reshape(-1)[index]], axis=1), count


def similarities(
    f0: JoinedFeatures,
    f1: JoinedFeatures,
    cells: Int[Array, "k 2"],
    found: Int[Array, ""],
    *,
    chunk: int = 512,
) -> Float[Array, " k"]:
    """Products of the fine descriptors of the first `found` correspondences.

    Entries after them are unspecified.
    """
    k = cells.shape[0]
    chunk = min(chunk, k)

    def body(state):
        i, scores = state
        # The last chunk is moved back to fit. The products that it repeats are written twice.
        start = jnp.minimum(i * chunk, k - chunk)
        some = lax.dynamic_slice_in_dim(cells, start, chunk)
        a, b = rows_of(f0.fine, some[:, 0]), rows_of(f1.fine, some[:, 1])
        products = descriptor_products("kd,kd->k", a, b)
        return i + 1, lax.dynamic_update_slice(scores, products, (start,))

    start = (jnp.int32(0), at_least_float32(jnp.zeros((k,), f0.fine.dtype)))
    return lax.while_loop(lambda s: s[0] * chunk < found, body, start)[1]


def one_to_one(
    cells: Int[Array, "k 2"],
    keep: Bool[Array, " k"],
    score: Float[Array, " k"],
    *,
    num_cells: int,
) -> Bool[Array, " k"]:
    """Which correspondences of `keep` survive, so that no cell of either image appears twice.

    First every cell of image 0 keeps its best correspondence. Then every cell of image 1 keeps the
    best of those. The higher score wins, and among equal scores the earlier entry.
    """
    k = cells.shape[0]
    for side in (0, 1):
        target = jnp.where(keep, cells[:, side], num_cells)
        best = jnp.full((num_cells,), -jnp.inf, score.dtype).at[target].max(score, mode="drop")
        wins = keep & (score == best[cells[:, side]])
        order = jnp.where(wins, jnp.arange(k, dtype=jnp.int32), k)
        first = jnp.full((num_cells,), k, jnp.int32).at[target].min(order, mode="drop")
        keep = wins & (order == first[cells[:, side]])
    return keep
