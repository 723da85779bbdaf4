"""3 x 3 convolution with 2.25 times fewer multiplications: Winograd's F(2 x 2, 3 x 3).

Tiles d of 4 x 4 inputs, two cells apart, become tiles of 2 x 2 outputs,
Y = A^T [(G g G^T) * (B^T d B)] A. The elementwise product, summed over the channels, is sixteen
matrix products. The transforms only add, subtract and halve, so the result differs from the plain
sum by rounding alone.

This is meant for CPUs, where XLA does not use the algorithm and its matrix products are as fast as
its convolutions. The libraries of accelerators choose among their own algorithms.

Source: Lavin and Gray 2016, "Fast algorithms for convolutional neural networks", section 4.1.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsfm.core.numerics import HIGHEST

TILES = 1024
"""Number of tiles that are transformed together. They fit into the cache and still give fast
products; 256 and 6144 are a tenth slower."""


def _inputs(d: Sequence[Array]) -> list[Array]:
    """B^T d along one axis."""
    return [d[0] - d[2], d[1] + d[2], d[2] - d[1], d[1] - d[3]]


def _outputs(m: Sequence[Array]) -> list[Array]:
    """A^T m along one axis."""
    return [m[0] + m[1] + m[2], m[1] - m[2] - m[3]]


def _kernels(g: Sequence[Array]) -> list[Array]:
    """G g along one axis."""
    even, odd = 0.5 * (g[0] + g[2]), 0.5 * g[1]
    return [g[0], even + odd, even - odd, g[2]]


def conv3x3(
    x: Float[Array, "h w c"], kernel: Float[Array, "3 3 c o"], *, tiles: int = TILES
) -> Float[Array, "h w o"]:
    """Correlation with zero padding of one cell, as `lax.conv` with padding SAME.

    Args:
      tiles: about this many tiles are held at once, in whole rows.
    """
    h, w, c = x.shape
    down, across = -(-h // 2), -(-w // 2)
    rows = max(1, min(down, tiles // across))
    strips = -(-down // rows)
    padded = jnp.pad(x, ((1, 2 * strips * rows - h + 1), (1, 2 * across - w + 1), (0, 0)))
    columns = [_kernels([kernel[i, j] for j in range(3)]) for i in range(3)]
    g = [_kernels([columns[i][e] for i in range(3)]) for e in range(4)]

    def strip(first):
        block = lax.dynamic_slice_in_dim(padded, first, 2 * rows + 2)
        block = block.reshape(rows + 1, 2, across + 1, 2, c)

        def corner(i: int, j: int) -> Array:
            """Entry (i, j) of all tiles of the strip."""
            part = block[i // 2 : rows + i // 2, i % 2, j // 2 : across + j // 2, j % 2]
            return part.reshape(rows * across, c)

        half = [_inputs([corner(i, j) for i in range(4)]) for j in range(4)]
        d = [_inputs([half[j][e] for j in range(4)]) for e in range(4)]
        # These are sixteen products. One batched product takes up to twice as long.
        m = [[jnp.matmul(d[e][f], g[f][e], precision=HIGHEST) for e in range(4)] for f in range(4)]
        half = [_outputs(m[f]) for f in range(4)]
        y = [_outputs([half[f][p] for f in range(4)]) for p in range(2)]
        pairs = [jnp.stack([v.reshape(rows, across, -1) for v in line], axis=2) for line in y]
        return jnp.stack(pairs, axis=1).reshape(2 * rows, 2 * across, -1)

    out = lax.map(strip, 2 * rows * jnp.arange(strips, dtype=jnp.int32))
    return out.reshape(2 * rows * strips, 2 * across, -1)[:h, :w]
