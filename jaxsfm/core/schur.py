"""The linear system of bundle adjustment, solved without points (the Schur complement).

Rows of one point meet in the reduced system, which has the size of the photos. For a long row of
photos it is a band (`jaxsfm.core.band`), and otherwise a dense matrix with a Cholesky factor. The
few numbers of shared cameras are its border (`jaxsfm.core.border`). With more photos than
`MOST_PHOTOS` of the layout that are no row, it is never formed: conjugate gradients multiply with
it row by row, and the blocks of its diagonal are the preconditioner.

Source: Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 6; Agarwal et al. 2010,
"Bundle adjustment in the large".
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsfm.core.band import BandFactor, band_factor, band_solve
from jaxsfm.core.border import Border, beside_of, corner_of, eliminated, with_border, without_inner
from jaxsfm.core.bundle_layout import Layout, gathered, places
from jaxsfm.core.bundle_problem import Normal
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
    lower: Float[Array, "n n"] | BandFactor | None  # of the reduced system, if it is formed
    border: Border | None  # of the reduced system: the cameras
    few: Float[Array, "b b"] | None  # the lower factor of what the border leaves of them
    determined: Bool[Array, " p"]  # which points the rows determine; others do not count
    positive: Bool[Array, ""]  # whether the reduced system has a factor; without a matrix, true
    solved: Bool[Array, ""]  # whether the rows determine the rest; without a matrix, true
    tolerance: Float[Array, ""]  # of conjugate gradients, as a share of the right side


def factor(
    model: Normal, layout: Layout, *, damping: Float[Array, ""] | float, tolerance: float
) -> Factor:
    """Eliminate the points."""
    dtype, d = model.points.dtype, model.mixed.shape[-1]
    inverse, determined = _inverse_factor(model.points, damping)
    points = beside = None
    if model.border is not None:
        points = (inverse[..., None] * model.border[:, None]).sum(2)
        beside = beside_of(model, layout)

    def without_points(k, state):
        blocks, mixed, beside = state
        photo, point = layout.photo[k], layout.point[k]
        rows = (inverse[point][..., None] * mixed[k][:, None]).sum(2)
        rows = lax.optimization_barrier(rows)
        known = jnp.einsum("bki,bkj->bij", rows, rows, precision=HIGHEST)
        if points is not None:
            both = jnp.einsum("bki,bkj->bij", rows, points[point], precision=HIGHEST)
            beside = beside.at[photo].add(-both)
        return blocks.at[photo].add(-known), mixed.at[k].set(rows), beside

    photos = model.photos[:, :d, :d]
    state = lax.fori_loop(0, layout.used[0], without_points, (photos, model.mixed, beside))
    blocks, mixed, beside = state
    whole = gathered(_diagonal(model.photos), layout)
    added = jnp.where(whole == 0, 1.0, damping * whole).astype(dtype)
    state = determined, jnp.bool_(True), jnp.bool_(True), jnp.asarray(tolerance, dtype)
    made = Factor(layout, inverse, mixed, photos, blocks, added, None, None, None, *state)
    if layout.pairs is None:
        return made
    few = 0 if points is None else points.shape[-1]
    inner, rest = jnp.split(whole, [len(whole) - few])
    if layout.band is None:
        own = jnp.diag(inner), added[: len(inner)]
        lower, positive, solved = _cholesky(_reduced(made, len(inner)), *own)
    else:
        lower, positive, solved = _band_cholesky(made, inner)
    made = made._replace(lower=lower, positive=positive, solved=solved)
    if points is None or beside is None:
        return made
    beside = beside.reshape(len(inner), few)
    known = eliminated(beside, functools.partial(_inner, made))
    corner = corner_of(model, layout) - jnp.einsum("pki,pkj->ij", points, points, precision=HIGHEST)
    left = without_inner(beside, known, corner)
    lower, positive, solved = _cholesky(left, jnp.diag(rest), added[len(inner) :])
    both = made.positive & positive, made.solved & solved
    made = made._replace(few=lower, border=Border(beside, known, points))
    return made._replace(positive=both[0], solved=both[1])


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
    elif made.border is None or made.few is None:
        x = _inner(made, left)
    else:
        inner, few = (functools.partial(f, x) for f, x in ((_inner, made), (_dense, made.few)))
        x = with_border(made.border, inner, few, left)
    return x, (made.inverse * (own - _to_points(made, x))[..., None]).sum(1)


def _inner(made: Factor, right: Float[Array, " n"]) -> Float[Array, " n"]:
    """The solution of the reduced system without its border."""
    if isinstance(made.lower, BandFactor):
        return _from_tiles(made.layout, band_solve(made.lower, _tiles(made.layout, right)))
    assert made.lower is not None
    return _dense(made.lower, right)


def _dense(lower: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    x = triangular_solve(lower, right[:, None])
    return triangular_solve(lower, x, transpose_a=True)[:, 0]


solve.defvjp(
    lambda made, right: (solve(made, right), made), lambda made, by: (None, solve(made, by))
)


def _known(made: Factor, count: int) -> Float[Array, "n d d"]:
    """The blocks that eliminating the points adds for photos with common points; each is there once
    for two photos."""
    d, pairs = made.blocks.shape[1], made.layout.pairs
    assert pairs is not None
    rows = made.mixed.reshape(-1, 3, d)

    def summed(k, blocks):
        index, block = (x[k] for x in pairs)
        both = rows.at[index].get(mode="fill", fill_value=0)
        one, other = (both[:, side].reshape(len(block), -1, d) for side in (0, 1))
        known = jnp.einsum("uki,ukj->uij", one, other, precision=HIGHEST)
        return blocks.at[block].add(-known)

    return lax.fori_loop(0, made.layout.used[1], summed, jnp.zeros((count, d, d), rows.dtype))


def _band_cholesky(
    made: Factor, whole: Float[Array, " z"]
) -> tuple[BandFactor, Bool[Array, ""], Bool[Array, ""]]:
    """As `_cholesky`, of the reduced system as a band."""
    layout, band = made.layout, made.layout.band
    assert band is not None
    (t, w), d = band.shape, made.blocks.shape[1]
    both = _known(made, 2 * t * w * w).reshape(t, 2, w, w, d, d)
    own = jnp.concatenate([made.blocks, jnp.zeros_like(made.blocks[:1])])[band]
    half = both[:, 0].at[:, jnp.arange(w), jnp.arange(w)].add(own / 2)
    half, beside = (x.swapaxes(2, 3).reshape(t, w * d, w * d) for x in (half, both[:, 1]))
    eye = jnp.eye(w * d, dtype=half.dtype)
    added = jnp.where(_tiles(layout, whole) == 0, 1.0, _tiles(layout, made.added[: len(whole)]))
    lower = band_factor(half + half.mT + added[..., None] * eye, beside)
    pivots, least = _from_tiles(layout, _diagonal(lower.lower)), _least(whole)
    positive, enough = jnp.all(pivots > 0), (pivots**2 > least) | (whole == 0)
    sound = BandFactor(jnp.broadcast_to(eye, lower.lower.shape), jnp.zeros_like(beside))
    lower = jax.tree.map(lambda x, other: jnp.where(positive, x, other), lower, sound)
    return lower, positive, jnp.all(enough)


def _tiles(layout: Layout, x: Float[Array, " z"]) -> Float[Array, "t s"]:
    """The numbers of the photos of each tile; 0 after the last photo."""
    assert layout.band is not None
    by_photo = jnp.concatenate([x.reshape(len(layout.camera), -1), jnp.zeros((1, 6), x.dtype)])
    return by_photo[layout.band].reshape(len(layout.band), -1)


def _from_tiles(layout: Layout, x: Float[Array, "t s"]) -> Float[Array, " z"]:
    """The numbers of all photos from those of tiles."""
    assert layout.band is not None
    to = jnp.zeros((len(layout.camera) + 1, 6), x.dtype)
    return to.at[layout.band.ravel()].set(x.reshape(-1, 6))[:-1].ravel()


def _reduced(made: Factor, size: int) -> Float[Array, "n n"]:
    """The matrix of the reduced system without its border and what damping adds."""
    c, d = made.blocks.shape[:2]
    half = _known(made, c * c).reshape(c, c, d, d)
    half = half.at[jnp.arange(c), jnp.arange(c)].add(made.blocks / 2)
    half = half.transpose(0, 2, 1, 3).reshape(c * d, c * d)
    matrix, to = half + half.T, places(made.layout)[:, :d].ravel()
    if d > 6:
        for _ in range(2):  # photos of one camera share its numbers
            matrix = jax.ops.segment_sum(matrix, to, size).T
    return matrix


def _to_points(made: Factor, x: Float[Array, " z"]) -> Float[Array, "p 3"]:
    """The mixed blocks times the numbers of the photos and cameras."""
    layout, d = made.layout, made.mixed.shape[-1]
    by = x[places(layout)[:, :d]]

    def added(k, sums):
        rows = (made.mixed[k] * by[layout.photo[k]][:, None]).sum(-1)
        return sums.at[layout.point[k]].add(rows)

    few, nothing = made.border, jnp.zeros(made.inverse.shape[:2], x.dtype)
    if few is not None:
        nothing = (few.points * x[-few.points.shape[-1] :]).sum(-1)
    return lax.fori_loop(0, layout.used[0], added, nothing)


def _to_photos(made: Factor, own: Float[Array, "p 3"]) -> Float[Array, " z"]:
    """The mixed blocks, transposed, times the numbers of the points."""
    layout = made.layout

    def added(k, sums):
        rows = (made.mixed[k] * own[layout.point[k]][..., None]).sum(1)
        return sums.at[layout.photo[k]].add(rows)

    sums = jnp.zeros(made.blocks.shape[:2], own.dtype)
    sums = lax.fori_loop(0, layout.used[0], added, sums)
    if made.border is None:
        return gathered(sums, layout)
    few = jnp.einsum("pkb,pk->b", made.border.points, own, precision=HIGHEST)
    return jnp.concatenate([sums.ravel(), few])


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
    lower, *_ = _cholesky(blocks, blocks, (share * made.added)[to] * scale**2)

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


def _inverse_factor(
    blocks: Float[Array, "p 3 3"], damping: Float[Array, ""] | float
) -> tuple[Float[Array, "p 3 3"], Bool[Array, " p"]]:
    """The inverse of the lower factor of each block with its damping, and whether the block
    determines its point or the point is held. Where it does not, the inverse is zero."""
    whole = _diagonal(blocks)
    a, d, f = ((1 + damping) * whole).T
    b, c, e = blocks[:, 1, 0], blocks[:, 2, 0], blocks[:, 2, 1]
    first = lax.rsqrt(a)
    ba, ca = b * first, c * first
    left = d - ba * ba
    second = lax.rsqrt(left)
    ec = (e - ca * ba) * second
    last = f - ca * ca - ec * ec
    third = lax.rsqrt(last)
    determined = jnp.all(jnp.stack([a, left, last], axis=1) > _least(whole), axis=1)
    lower = -ba * first * second, -ec * second * third
    corner = (ba * ec * second - ca) * first * third
    zero = jnp.zeros_like(a)
    rows = [first, zero, zero, lower[0], second, zero, corner, lower[1], third]
    inverse = jnp.stack(rows, axis=1).reshape(-1, 3, 3)
    inverse = jnp.where(determined[:, None, None], inverse, 0.0)
    return inverse, determined | jnp.all(whole == 0, axis=1)  # held points have no rows


def _least(whole: Float[Array, "*n k"]) -> Float[Array, "*n k"]:
    """The least pivot of numbers that are determined."""
    # A pivot is what is known of a number while those before it are free. If it is below this share
    # of what is known while they are held, it is rounding (1e-4 in float32; scenes have 2.5e-4).
    share = 0.3 * float(jnp.finfo(whole.dtype).eps) ** 0.5
    return jnp.maximum(whole, share * whole.max(-1, keepdims=True)) * share


def _cholesky(
    matrix: Float[Array, "*n k k"], whole: Float[Array, "*n k k"], added: Float[Array, "*n k"]
) -> tuple[Float[Array, "*n k k"], Bool[Array, "*n"], Bool[Array, "*n"]]:
    """The lower factor of matrix + diag(added), or the identity if there is none; whether there is
    one; and whether it determines every number. Numbers that are held have no row in `whole`, and
    get a diagonal of 1."""
    eye, diagonal = jnp.eye(matrix.shape[-1], dtype=matrix.dtype), _diagonal(whole)
    added = jnp.where(diagonal == 0, 1.0, added).astype(matrix.dtype)
    lower = lax.linalg.cholesky(matrix + added[..., None] * eye)
    enough = _diagonal(lower) ** 2 > _least(diagonal)
    determined = jnp.all(enough | (diagonal == 0), axis=-1)
    positive = jnp.all(_diagonal(lower) > 0, axis=-1)
    return jnp.where(positive[..., None, None], lower, eye), positive, determined
