"""Keypoint relocalization: every fine cell walks down the pyramid to one pixel.

From a pool3 cell to the child of its 2 x 2 block in pool2 with the largest descriptor norm, then in
pool1, then in conv1_2 (paper, section 3.2). It depends on one image alone, so a keypoint's index is
its cell's index in every pair, and tracks are consistent by construction. Children of different
cells are disjoint: two keypoints never coincide.

The levels differ in shape, which `lax.scan` does not allow; their norm maps are therefore laid end
to end in one vector and the scan runs over (offset, width).
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

FACTOR = 2
"""Children per axis: the pyramid's own ratio (K in the paper)."""


def flat_pyramid(
    norms: Sequence[Float[Array, "_h _w"]],
) -> tuple[Float[Array, " total"], Int[Array, "levels 2"]]:
    """Norm maps in one vector, and (offset, width) of each.

    Args:
      norms: of the descriptors of feature maps, coarse to fine, each twice the size of the last;
        squared norms order as norms do.
    """
    offsets, start = [], 0
    for norm in norms:
        offsets.append((start, norm.shape[1]))
        start += norm.size
    return (
        jnp.concatenate([norm.reshape(-1) for norm in norms]),
        jnp.asarray(offsets, jnp.int32),
    )


def relocalize(
    flat_norms: Float[Array, " total"],
    levels: Int[Array, "levels 2"],
    row: Int[Array, " m"],
    col: Int[Array, " m"],
) -> Float[Array, "m 2"]:
    """(x, y) of the pixel every cell walks to, in pixels of the finest map.

    Ties go to the first child in the order (0,0), (0,1), (1,0), (1,1) as (row, col), as in the
    authors' code. Cells whose children lie outside the maps give unspecified in-range values.

    Args:
      flat_norms, levels: from `flat_pyramid`.
      row, col: cells of the level above the first one.
    """
    child_row = jnp.asarray([0, 0, 1, 1], jnp.int32)
    child_col = jnp.asarray([0, 1, 0, 1], jnp.int32)

    def descend(cell, level):
        offset, width = level
        rows = FACTOR * cell[0][:, None] + child_row
        cols = FACTOR * cell[1][:, None] + child_col
        norms = jnp.take(flat_norms, offset + rows * width + cols, mode="clip")
        best = jnp.argmax(norms, axis=1)
        pick = jnp.arange(best.shape[0])
        return (rows[pick, best], cols[pick, best]), None

    (row, col), _ = lax.scan(descend, (row, col), (levels[:, 0], levels[:, 1]))
    return jnp.stack([col, row], axis=-1).astype(jnp.float32)
