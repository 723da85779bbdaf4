"""3 x 3 convolution with four times fewer multiplications: Winograd's F(4 x 4, 3 x 3).

Tiles d of 6 x 6 inputs, four cells apart, become tiles of 4 x 4 outputs,
Y = A^T [(G g G^T) * (B^T d B)] A. The elementwise product, summed over the channels, is thirty-six
matrix products. The result is exact but for rounding. Rounding depends on the points at which the
polynomials behind the transforms are evaluated: 0, +-3/4, +-3/2 and infinity round half as much as
the usual 0, +-1, +-2 and infinity.

This is meant for CPUs, where XLA does not use the algorithm and its matrix products are as fast as
its convolutions. The libraries of accelerators choose among their own algorithms.

Source: Lavin and Gray 2016, "Fast algorithms for convolutional neural networks", section 4.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsfm.core.numerics import HIGHEST

A, B = 0.75, 1.5
"""The points. Their squares are exact, too."""
SUM, PRODUCT = A**2 + B**2, A**2 * B**2


def _inputs(d: Sequence[Array]) -> list[Array]:
    """B^T d along one axis, six entries."""
    a, a_odd = d[4] - B**2 * d[2], A * (d[3] - B**2 * d[1])
    b, b_odd = d[4] - A**2 * d[2], B * (d[3] - A**2 * d[1])
    first, last = (PRODUCT * d[k] - SUM * d[k + 2] + d[k + 4] for k in (0, 1))
    return [first, a + a_odd, a - a_odd, b + b_odd, b - b_odd, last]


def _outputs(m: Sequence[Array]) -> list[Array]:
    """A^T m along one axis, four entries."""
    a, a_odd = m[1] + m[2], A * (m[1] - m[2])
    b, b_odd = m[3] + m[4], B * (m[3] - m[4])
    return [m[0] + a + b, a_odd + b_odd, A**2 * a + B**2 * b, A**2 * a_odd + B**2 * b_odd + m[5]]


def _kernels(g: Sequence[Array]) -> list[Array]:
    """G g along one axis, six entries."""

    def at(p: float, other: float) -> list[Array]:
        scale = 1 / (2 * p**2 * (p**2 - other**2))
        even, odd = scale * (g[0] + p**2 * g[2]), scale * p * g[1]
        return [even + odd, even - odd]

    return [g[0] / PRODUCT, *at(A, B), *at(B, A), g[2]]


def _transformed(kernel: Float[Array, "3 3 c o"]) -> Float[Array, "6 6 c o"]:
    """G g G^T."""
    lines = jnp.stack(_kernels([kernel[i] for i in range(3)]))
    return jnp.stack(_kernels([lines[:, j] for j in range(3)]), axis=1)


def conv3x3(
    x: Float[Array, "h w c"], kernel: Float[Array, "3 3 c o"], *, tiles: int | None = None
) -> Float[Array, "h w o"]:
    """Correlation with zero padding of one cell, as `lax.conv` with padding SAME.

    Args:
      tiles: about this many tiles are held at once, in whole rows. `None` stands for the number
        of outputs: the tiles then fit into the cache, and their products are still fast.
    """
    h, w, c = x.shape
    down, across = -(-h // 4), -(-w // 4)
    rows = max(1, min(down, (tiles or kernel.shape[3]) // across))
    strips = -(-down // rows)
    padded = jnp.pad(x, ((1, 4 * strips * rows - h + 3), (1, 4 * across - w + 3), (0, 0)))
    transformed = _transformed(kernel)

    def strip(first):
        block = lax.dynamic_slice_in_dim(padded, first, 4 * rows + 4)
        lines = block.reshape(rows + 1, 4, 4 * across + 4, c)
        vertical = jnp.stack(_inputs([lines[i // 4 : rows + i // 4, i % 4] for i in range(6)]))
        # A loop over the six lines, because it compiles four times as fast as six copies.
        sums = lax.map(lambda line: horizontal(*line), (vertical, transformed))
        return jnp.stack(_outputs(list(sums)), axis=1).reshape(4 * rows, 4 * across, -1)

    def horizontal(line, kernels):
        """The transforms along the lines, and the products between them."""
        line = line.reshape(rows, across + 1, 4, c)
        parts = [line[:, j // 4 : across + j // 4, j % 4].reshape(-1, c) for j in range(6)]
        # These are six products. One batched product takes up to twice as long.
        m = [jnp.matmul(d, kernels[f], precision=HIGHEST) for f, d in enumerate(_inputs(parts))]
        return jnp.stack(_outputs(m), axis=1).reshape(rows, 4 * across, -1)

    out = lax.map(strip, 4 * rows * jnp.arange(strips, dtype=jnp.int32))
    return out.reshape(4 * rows * strips, 4 * across, -1)[:h, :w]
