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
from jaxsfm.core.numerics import inverse_norm
from jaxsfm.core.types import DenseFeatures, JoinedFeatures, OctavePart

OCTAVE_WEIGHT = 0.5
"""Of an octave's products, relative to the octave before: 1, 1/2, 1/4, ... Equal weights find a
quarter more at night, but lose 0.1 mAA on photos of 800 px (docs/decisions/features.md)."""


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


def blend(
    rows: Float[Array, "k c"], cells: Int[Array, "n 4"], weights: Float[Array, "n 4"]
) -> Float[Array, "n c"]:
    """Weighted sums of four rows each."""

    def nth(i):
        return weights[:, i : i + 1] * jnp.take(rows, cells[:, i], axis=0, mode="clip")

    return (nth(0) + nth(1)) + (nth(2) + nth(3))


def _join(
    octaves: Sequence[Array], grid: Int[Array, " 2"]
) -> tuple[Float[Array, "n kc"], tuple[OctavePart, ...]]:
    """The octaves' unit descriptors at the first one's cells, each times the root of its weight,
    side by side, unit together; and what the channels after the first octave's are made of.

    Between the centres of coarser cells: bilinear; beyond the outermost: theirs.
    """
    octaves = [flat.astype(jnp.float32) for flat in octaves]
    first = octaves[0]
    if len(octaves) == 1:
        return first, ()
    row, col = cell_rows_cols(first.shape[0], grid[1])
    # A cell that shows nothing at full size has no keypoint worth matching either.
    shown = (row < grid[0]) & jnp.any(first != 0, axis=1)
    columns, parts = [first], []
    for k, flat in enumerate(octaves[1:], start=1):
        rows, cols = grid[0] >> k, grid[1] >> k
        y0, y1, down = _between(row, rows, k)
        x0, x1, right = _between(col, cols, k)
        cells = jnp.stack([y0 * cols + x0, y0 * cols + x1, y1 * cols + x0, y1 * cols + x1], axis=1)
        weights = jnp.stack(
            [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=1
        )
        total = blend(flat, cells, weights)
        share = jnp.where(shown, math.sqrt(OCTAVE_WEIGHT**k), 0.0) * inverse_norm(total)
        columns.append(share[:, None] * total)
        parts.append(OctavePart(flat, cells, share[:, None] * weights))
    joined = jnp.concatenate(columns, axis=1)
    scale = jnp.where(shown, inverse_norm(joined), 0.0)[:, None]
    return joined * scale, tuple(p._replace(weights=p.weights * scale) for p in parts)


def join_octaves(features: DenseFeatures) -> JoinedFeatures:
    """What an image brings to a pair: products of these descriptors are weighted means over the
    octaves."""
    coarse, parts = _join(features.coarse, features.coarse_grid)
    return JoinedFeatures(
        coarse=coarse,
        fine=_join(features.fine, features.fine_grid)[0],
        keypoints=features.keypoints,
        coarse_grid=features.coarse_grid,
        fine_grid=features.fine_grid,
        coarse_parts=parts,
    )
