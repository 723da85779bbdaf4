"""Octaves: an image described at its size, at half its size, at a quarter.

Photon noise defeats the network at full size before it does at half or a quarter, and what is far
apart in a view comes close together there. Every cell of the first octave gets the descriptors of
all octaves at its place, so products are weighted means over the octaves and cells, keypoints and
tracks stay those of the first.
"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsfm.core.grid import cell_rows_cols
from jaxsfm.core.numerics import unit
from jaxsfm.core.types import DenseFeatures, JoinedFeatures

OCTAVE_WEIGHT = 0.5
"""Of an octave's products, relative to the octave before: 1, 1/2, 1/4, ... Equal weights find a
quarter more at night, but lose 0.1 mAA on photos of 800 px (docs/design.md)."""


def halve(x: Float[Array, "h w c"]) -> Float[Array, "h2 w2 c"]:
    """Means of 2 x 2 pixels; pixel (u, v) lies at (2 u + 0.5, 2 v + 0.5) of the whole image.

    Both sides must be even.
    """
    h, w, c = x.shape
    return x.reshape(h // 2, 2, w // 2, 2, c).mean(axis=(1, 3))


def octave_capacity(capacity: int, octave: int) -> int:
    """Room for an octave's cells, where `capacity` is the first one's."""
    return -(-capacity // 4**octave)


def _between(
    cell: Int[Array, " n"], count: Int[Array, ""], octave: int
) -> tuple[Int[Array, " n"], Int[Array, " n"], Float[Array, " n"]]:
    """The two of an octave's `count` cells along an axis around a cell's centre, and the share of
    the second."""
    last = jnp.maximum(count - 1, 0)
    place = (cell.astype(jnp.float32) + 0.5) / 2**octave - 0.5
    place = jnp.clip(place, 0.0, last.astype(jnp.float32))
    first = jnp.floor(place).astype(jnp.int32)
    return first, jnp.minimum(first + 1, last), place - jnp.floor(place)


def _join(octaves: Sequence[Array], grid: Int[Array, " 2"]) -> Float[Array, "n kc"]:
    """The octaves' unit descriptors at the first one's cells, each times the root of its weight,
    side by side, unit together.

    Between the centres of coarser cells: bilinear; beyond the outermost: theirs.
    """
    if len(octaves) == 1:
        return octaves[0]
    n = octaves[0].shape[0]
    row, col = cell_rows_cols(n, grid[1])
    parts = [octaves[0]]
    for k, flat in enumerate(octaves[1:], start=1):
        rows, cols = grid[0] >> k, grid[1] >> k
        y0, y1, down = _between(row, rows, k)
        x0, x1, right = _between(col, cols, k)

        def at(y, x, weight, flat=flat, cols=cols):
            return weight[:, None] * jnp.take(flat, y * cols + x, axis=0, mode="clip")

        above = at(y0, x0, (1 - down) * (1 - right)) + at(y0, x1, (1 - down) * right)
        total = above + at(y1, x0, down * (1 - right)) + at(y1, x1, down * right)
        there = (row < grid[0]) & (rows > 0) & (cols > 0)
        share = math.sqrt(OCTAVE_WEIGHT**k)
        parts.append(jnp.where(there[:, None], share * unit(total), 0.0))
    # A cell that shows nothing at full size has no keypoint worth matching either.
    return jnp.where(
        jnp.any(octaves[0] != 0, axis=1)[:, None], unit(jnp.concatenate(parts, axis=1)), 0.0
    )


def join_octaves(features: DenseFeatures) -> JoinedFeatures:
    """What an image brings to a pair: products of these descriptors are weighted means over the
    octaves."""
    return JoinedFeatures(
        coarse=_join(features.coarse, features.coarse_grid),
        fine=_join(features.fine, features.fine_grid),
        keypoints=features.keypoints,
        coarse_grid=features.coarse_grid,
        fine_grid=features.fine_grid,
    )
