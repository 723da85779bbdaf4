"""Symmetric systems with a border: a large part that is solved by itself, and a few numbers on
which all of it depends.

The few numbers are those of cameras that many photos share. With them in the large part, it would
be no band, and each of its blocks would be larger.

Source: Golub and Van Loan 2013, "Matrix computations", section 3.2 (block elimination).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsfm.core.bundle_layout import Layout
from jaxsfm.core.bundle_problem import Normal
from jaxsfm.core.numerics import HIGHEST

Solve = Callable[[Float[Array, " n"]], Float[Array, " n"]]


class Border(NamedTuple):
    """A system [A E; E^T F], whose large part A is solved by a function."""

    beside: Float[Array, "n b"]
    """E."""
    solved: Float[Array, "n b"]
    """A^-1 E."""
    points: Float[Array, "p 3 b"]
    """The mixed blocks of points and the few numbers, times the points' inverse factors. Points
    have been eliminated from E and F."""


def eliminated(beside: Float[Array, "n b"], solve: Solve) -> Float[Array, "n b"]:
    """A^-1 E."""
    return jax.vmap(solve, 1, 1)(beside)


def without_inner(
    beside: Float[Array, "n b"], solved: Float[Array, "n b"], corner: Float[Array, "b b"]
) -> Float[Array, "b b"]:
    """What is left of F, F - E^T A^-1 E."""
    known = jnp.einsum("ni,nj->ij", beside, solved, precision=HIGHEST)
    return corner - (known + known.T) / 2


def with_border(
    border: Border,
    solve: Solve,
    solve_few: Callable[[Float[Array, " b"]], Float[Array, " b"]],
    right: Float[Array, " z"],
) -> Float[Array, " z"]:
    """The solution of the whole system.

    Args:
      solve_few: solves F - E^T A^-1 E.
      right: of the large part, and then of the few numbers.
    """
    n = len(border.beside)
    x = solve(right[:n])
    few = solve_few(right[n:] - jnp.einsum("nb,n->b", border.beside, x, precision=HIGHEST))
    x -= jnp.einsum("nb,b->n", border.solved, few, precision=HIGHEST)
    return jnp.concatenate([x, few])


def beside_of(model: Normal, layout: Layout) -> Float[Array, "c d b"]:
    """The blocks of photos and cameras."""
    (c, _, f), d, k = model.photos.shape, model.mixed.shape[-1], len(layout.model)
    own = model.photos[:, :d, d:].swapaxes(0, 1)
    wide = jnp.zeros((d, c, k, f - d), own.dtype).at[:, jnp.arange(c), layout.camera].set(own)
    return wide.swapaxes(0, 1).reshape(c, d, -1)


def corner_of(model: Normal, layout: Layout) -> Float[Array, "b b"]:
    """The blocks of cameras."""
    d, k = model.mixed.shape[-1], len(layout.model)
    own = jax.ops.segment_sum(model.photos[:, d:, d:], layout.camera, k)
    m = own.shape[-1]
    wide = jnp.zeros((k, k, m, m), own.dtype).at[jnp.arange(k), jnp.arange(k)].set(own)
    return wide.swapaxes(1, 2).reshape(k * m, k * m)
