"""The linear system of bundle adjustment, solved without points (the Schur complement).

Rows of one point meet in the reduced system, which has the size of the photos. Up to some hundred
photos it is a dense matrix with a Cholesky factor. Above, it is never formed: conjugate gradients
multiply with it row by row, and the blocks of its diagonal are the preconditioner.

Source: Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 6; Agarwal et al. 2010,
"Bundle adjustment in the large".
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsfm.core.bundle_problem import Layout, Normal, gathered, places
from jaxsfm.core.numerics import HIGHEST

triangular_solve = functools.partial(lax.linalg.triangular_solve, left_side=True, lower=True)


class Factor(NamedTuple):
    """What solves H + damping diag(H) for any right side."""

    layout: Layout
    inverse: Float[Array, "p 3 3"]  # of the points' lower factors; 0 where not determined
    mixed: Float[Array, "s b 3 d"]  # the rows' mixed blocks, times `inverse`
    photos: Float[Array, "c d d"]  # the photos' blocks before points are eliminated
    blocks: Float[Array, "c d d"]  # and after
    added: Float[Array, " z"]  # to the diagonal: damping, and 1 for numbers that are held
    lower: Float[Array, "z z"] | None  # the factor of the reduced system, if it is a matrix
    determined: Bool[Array, " p"]  # which points the rows determine; others do not count
    solved: Bool[Array, ""]  # whether they determine the rest; without a matrix, true
    tolerance: Float[Array, ""]  # of conjugate gradients, as a share of the right side


def factor(
    model: Normal, layout: Layout, *, damping: Float[Array, ""] | float, tolerance: float
) -> Factor:
    """Eliminate the points."""
    dtype = model.points.dtype
    lower, determined = _cholesky(model.points, model.points, damping * _diagonal(model.points))
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), lower.shape)
    inverse = jnp.where(determined[:, None, None], triangular_solve(lower, eye), 0.0)

    def eliminated(blocks, rows):
        photo, point, mixed = rows
        mixed = lax.optimization_barrier((inverse[point][..., None] * mixed[:, None]).sum(2))
        known = jnp.einsum("bki,bkj->bij", mixed, mixed, precision=HIGHEST)
        return blocks.at[photo].add(-known), mixed

    rows = layout.photo, layout.point, model.mixed
    blocks, mixed = lax.scan(eliminated, model.photos, rows)
    whole = gathered(_diagonal(model.photos), layout)
    added = jnp.where(whole == 0, 1.0, damping * whole).astype(dtype)
    state = None, determined, jnp.bool_(True), jnp.asarray(tolerance, dtype)
    made = Factor(layout, inverse, mixed, model.photos, blocks, added, *state)
    if layout.pairs is None:
        return made
    lower, solved = _cholesky(_reduced(made), jnp.diag(whole), added)
    return made._replace(lower=lower, solved=solved)


@jax.custom_vjp
def solve(
    made: Factor, right: tuple[Float[Array, " z"], Float[Array, "p 3"]]
) -> tuple[Float[Array, " z"], Float[Array, "p 3"]]:
    """The solution for a right side. H is symmetric, so a derivative costs one more solution. It
    takes H as constant."""
    own = (made.inverse * right[1][:, None]).sum(-1)
    left = right[0] - _to_photos(made, own)
    if made.lower is None:
        x = _iterated(made, left)
    else:
        x = triangular_solve(made.lower, left[:, None])
        x = triangular_solve(made.lower, x, transpose_a=True)[:, 0]
    return x, (made.inverse * (own - _to_points(made, x))[..., None]).sum(1)


solve.defvjp(
    lambda made, right: (solve(made, right), made), lambda made, by: (None, solve(made, by))
)


def _reduced(made: Factor) -> Float[Array, "z z"]:
    """The matrix of the reduced system without what damping adds."""
    c, d = made.blocks.shape[:2]
    rows = made.mixed.reshape(-1, 3, d)

    def summed(blocks, pairs):
        index, block = pairs
        both = rows.at[index].get(mode="fill", fill_value=0)
        one, other = (both[:, side].reshape(len(block), -1, d) for side in (0, 1))
        known = jnp.einsum("uki,ukj->uij", one, other, precision=HIGHEST)
        return blocks.at[block].add(-known), None

    zeros = jnp.zeros((c * c, d, d), rows.dtype)
    half = lax.scan(summed, zeros, made.layout.pairs)[0].reshape(c, c, d, d)
    half = half.at[jnp.arange(c), jnp.arange(c)].add(made.blocks / 2)
    half = half.transpose(0, 2, 1, 3).reshape(c * d, c * d)
    matrix, to = half + half.T, places(made.layout).ravel()
    for _ in range(2):  # photos of one camera share its numbers
        matrix = jax.ops.segment_sum(matrix, to, len(made.added)).T
    return matrix


def _to_points(made: Factor, x: Float[Array, " z"]) -> Float[Array, "p 3"]:
    """The mixed blocks times the numbers of the photos."""
    by = x[places(made.layout)][made.layout.photo]
    rows = (made.mixed * by[..., None, :]).sum(-1)
    return jnp.zeros(made.inverse.shape[:2], x.dtype).at[made.layout.point].add(rows)


def _to_photos(made: Factor, own: Float[Array, "p 3"]) -> Float[Array, " z"]:
    """The mixed blocks, transposed, times the numbers of the points."""
    rows = (made.mixed * own[made.layout.point][..., None]).sum(-2)
    sums = jnp.zeros(made.blocks.shape[:2], own.dtype).at[made.layout.photo].add(rows)
    return gathered(sums, made.layout)


def _multiplied(made: Factor, x: Float[Array, " z"]) -> Float[Array, " z"]:
    """The reduced and damped system times a vector."""
    own = (made.photos * x[places(made.layout)][:, None]).sum(-1)
    return gathered(own, made.layout) + made.added * x - _to_photos(made, _to_points(made, x))


def _iterated(made: Factor, right: Float[Array, " z"]) -> Float[Array, " z"]:
    """The solution of the reduced system by conjugate gradients. The preconditioner has the inverse
    of each photo's block; a camera of several photos gets the mean of theirs."""
    layout, to = made.layout, places(made.layout)
    unit = lax.rsqrt(gathered(_diagonal(made.photos), layout) + made.added)  # all kinds count alike
    share = 1 / jnp.maximum(gathered(jnp.ones(to.shape, unit.dtype), layout), 1)
    scale = unit[to]
    blocks = made.blocks * scale[:, None] * scale[..., None]
    lower, _ = _cholesky(blocks, blocks, (share * made.added)[to] * scale**2)

    def preconditioned(x):
        half = triangular_solve(lower, (share * x)[to][..., None])
        return share * gathered(triangular_solve(lower, half, transpose_a=True)[..., 0], layout)

    found, _ = jax.scipy.sparse.linalg.cg(
        lambda x: unit * _multiplied(made, unit * x),
        unit * right,
        tol=made.tolerance,  # pyright: ignore[reportArgumentType]  # it may be traced
        maxiter=10 * len(right),
        M=preconditioned,
    )
    return unit * found


def _diagonal(blocks: Float[Array, "*n k k"]) -> Float[Array, "*n k"]:
    return jnp.diagonal(blocks, axis1=-2, axis2=-1)


def _cholesky(
    matrix: Float[Array, "*n k k"], whole: Float[Array, "*n k k"], added: Float[Array, "*n k"]
) -> tuple[Float[Array, "*n k k"], Bool[Array, "*n"]]:
    """The lower factor of matrix + diag(added), and whether it determines every number; if not, the
    identity. Numbers that are held have no row in `whole`, and get a diagonal of 1."""
    eye, diagonal = jnp.eye(matrix.shape[-1], dtype=matrix.dtype), _diagonal(whole)
    added = jnp.where(diagonal == 0, 1.0, added).astype(matrix.dtype)
    lower = lax.linalg.cholesky(matrix + added[..., None] * eye)
    # A pivot is what is known of a number while those before it are free. If it is below this share
    # of what is known while they are held, it is rounding (1e-4 in float32; scenes have 2.5e-4).
    share = 0.3 * float(jnp.finfo(matrix.dtype).eps) ** 0.5
    least = jnp.maximum(diagonal, share * diagonal.max(-1, keepdims=True)) * share
    determined = jnp.all((_diagonal(lower) ** 2 > least) | (diagonal == 0), axis=-1)
    return jnp.where(determined[..., None, None], lower, eye), determined
