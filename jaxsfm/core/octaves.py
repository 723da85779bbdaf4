"""Octaves: an image is described at its size, at half of it, at a quarter, and so on.

At full size, photon noise makes the network fail earlier than at half or a quarter of the size. At
smaller sizes a cell also sees a larger part of the scene. Every cell of the first octave gets the
descriptors of all octaves at its place, so the product of two cells is a weighted mean over the
octaves. Cells, keypoints and tracks stay those of the first octave.
"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsfm.core.grid import FINE_STRIDE, cell_rows_cols, cell_to_px
from jaxsfm.core.numerics import at_least_float32, inverse_norm
from jaxsfm.core.pair_shape import Products
from jaxsfm.core.types import DenseFeatures, JoinedFeatures, OctavePart

OCTAVE_WEIGHT = 0.5
"""Weight of the products of an octave relative to the octave before: 1, 1/2, 1/4, ... Equal weights
find a quarter more matches at night, but lose 0.1 mAA on photos of 800 px
(docs/decisions/features.md)."""


def halve(x: Float[Array, "h w c"]) -> Float[Array, "h2 w2 c"]:
    """Means of 2 x 2 pixels. Pixel (u, v) lies at (2 u + 0.5, 2 v + 0.5) of the given image.

    Both sides must be even.
    """
    h, w, c = x.shape
    return x.reshape(h // 2, 2, w // 2, 2, c).mean(axis=(1, 3))


def octave_capacity(capacity: int, octave: int) -> int:
    """Capacity for the cells of an octave, where the first octave has `capacity`."""
    return -(-capacity // 4**octave)


def _between(
    cell: Int[Array, " n"], count: Int[Array, ""], octave: int
) -> tuple[Int[Array, " n"], Int[Array, " n"], Float[Array, " n"]]:
    """Along one axis, the two cells of an octave around the centre of a cell of the first octave,
    and the weight of the second one.

    Args:
      cell: index of the cell in the first octave.
      count: number of cells of the octave along the axis.
    """
    last = jnp.maximum(count - 1, 0)
    place = (cell.astype(jnp.float32) + 0.5) / 2**octave - 0.5
    place = jnp.clip(place, 0.0, last.astype(jnp.float32))
    first = jnp.floor(place).astype(jnp.int32)
    return first, jnp.minimum(first + 1, last), place - jnp.floor(place)


def blend(
    rows: Float[Array, "k c"], cells: Int[Array, "n 4"], weights: Float[Array, "n 4"]
) -> Float[Array, "n c"]:
    """For each of n cells the weighted sum of four rows."""
    weights = at_least_float32(weights)

    def nth(i):
        return weights[:, i : i + 1] * jnp.take(rows, cells[:, i], axis=0, mode="clip")

    return (nth(0) + nth(1)) + (nth(2) + nth(3))


def _join(
    octaves: Sequence[Array], grid: Int[Array, " 2"]
) -> tuple[Float[Array, "n kc"], tuple[OctavePart, ...]]:
    """Joined unit descriptors at the cells of the first octave, and how the channels after those of
    the first octave are made.

    The unit descriptor of each octave is multiplied by the root of its weight. All of them are
    concatenated, and the result is scaled to unit length. Between the centres of an octave's cells,
    descriptors are interpolated bilinearly; beyond the outermost centres they are constant.
    """
    octaves = [flat.astype(jnp.float32) for flat in octaves]
    first = octaves[0]
    if len(octaves) == 1:
        return first, ()
    row, col = cell_rows_cols(first.shape[0], grid[1])
    # A cell that shows nothing at full size has no keypoint that is worth matching.
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


def join_octaves(features: DenseFeatures, *, products: Products = "float32") -> JoinedFeatures:
    """The features of an image with its octaves joined: the product of two joined descriptors is a
    weighted mean of the products in the octaves.

    Args:
      products: type of the joined descriptors, of which products are computed. They are joined in
        float32 and then rounded to it.
    """
    coarse, parts = _join(features.coarse, features.coarse_grid)
    return JoinedFeatures(
        coarse=coarse.astype(products),
        fine=_join(features.fine, features.fine_grid)[0].astype(products),
        keypoints=features.keypoints,
        coarse_grid=features.coarse_grid,
        fine_grid=features.fine_grid,
        coarse_parts=tuple(part._replace(flat=part.flat.astype(products)) for part in parts),
    )


def smaller(
    features: DenseFeatures, octave: int, *, fine_stride: int = FINE_STRIDE
) -> DenseFeatures:
    """The features of an image at 1 / 2^`octave` of its size, without describing it again.

    Octave `octave` of the image is the first octave of the smaller one. The octaves that then lack
    at the end are zero, so they add nothing to a product, and the arrays keep their number. Only
    the keypoints of the first octave are relocalized, so those of the smaller image lie at the
    centres of its fine cells. They are in its pixels: pixel (u, v) of a halved image lies at (2 u +
    0.5, 2 v + 0.5) of the image.

    Args:
      fine_stride: stride of the fine maps, pixels.

    Raises:
      ValueError: the image has no such octave.
    """
    count = len(features.coarse)
    if not 0 <= octave < count:
        raise ValueError(f"octave must lie in 0..{count - 1}; got {octave}")
    if octave == 0:
        return features

    def moved(octaves: Sequence) -> tuple[Array, ...]:
        left = [jnp.asarray(each) for each in octaves[octave:]]
        rows, channels = left[0].shape
        lacking = (
            jnp.zeros((octave_capacity(rows, k), channels), left[0].dtype)
            for k in range(len(left), count)
        )
        return (*left, *lacking)

    coarse_grid = jnp.asarray(features.coarse_grid) >> octave
    fine_grid = jnp.asarray(features.fine_grid) >> octave
    row, col = cell_rows_cols(features.fine[octave].shape[0], jnp.maximum(fine_grid[1], 1))
    centres = cell_to_px(jnp.stack([col, row], axis=-1).astype(jnp.float32), stride=fine_stride)
    return DenseFeatures(
        coarse=moved(features.coarse),
        fine=moved(features.fine),
        keypoints=jnp.where((row < fine_grid[0])[:, None], centres, 0.0),
        coarse_grid=coarse_grid,
        fine_grid=fine_grid,
    )
