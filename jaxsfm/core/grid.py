"""The pixel convention, and the cells of feature maps.

Points are (x, y) in pixels, and the centre of the top-left pixel is (0, 0). Cell (u, v) of stride s
covers the pixels s*u .. s*u + s - 1 along x and has its centre at (u + 0.5) s - 0.5. Images are
resized per axis with half-pixel centres. In COLMAP's files the centre of the top-left pixel is
(0.5, 0.5); `jaxsfm.colmap` adds the half.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

FINE_STRIDE = 8


def cell_to_px(cell_xy: Float[Array, "*n 2"], *, stride: int) -> Float[Array, "*n 2"]:
    """The centre of a cell, pixels."""
    return (cell_xy + 0.5) * stride - 0.5


def cell_rows_cols(capacity: int, columns: Int[Array, ""]) -> tuple[Array, Array]:
    """The rows and the columns of cells 0 .. capacity - 1 of a grid with `columns` columns."""
    index = jnp.arange(capacity, dtype=jnp.int32)
    return index // columns, index % columns
