"""What a bundle adjustment works on, its cost, and the quadratic model of the cost.

Rows, and the numbers of a photo, are those of a layout (`jaxsfm.core.bundle_layout`). A point has
three numbers: directions at right angles to its homogeneous vector.
"""

import functools
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsfm.core.bundle_layout import Layout, gathered
from jaxsfm.core.cameras import numbers_of, projected, spread
from jaxsfm.core.cameras import slopes as slopes_of_rays
from jaxsfm.core.numerics import HIGHEST, across, squared_norm

FLATTEST = 2 / 3
"""The second derivative of a robust loss along a residual counts at least so much of its influence.
By one step, a single residual then becomes at most half as large, on the other side of zero. With
1/2 it would become as large as it was, and adjustments of real models do not converge
(docs/decisions/relocalization.md)."""
Loss = Literal["cauchy", "huber"]


class Poses(NamedTuple):
    """A point X of the world has the camera coordinates R X + t."""

    rotations: Float[Array, "c 3 3"]
    translations: Float[Array, "c 3"]


class Scene(NamedTuple):
    """What is adjusted."""

    poses: Poses
    points: Float[Array, "p 4"]
    """Homogeneous; in results of length 1. The last coordinate is 0 at infinity."""
    params: Float[Array, "k 8"]
    """Of cameras (`jaxsfm.core.cameras.intrinsics_of`). Photos may share a camera."""


class Observations(NamedTuple):
    """Keypoints, in the order of the rows of a layout."""

    xy: Float[Array, "n 2"]
    """Pixels; finite also where the weight is 0."""
    weight: Float[Array, " n"]
    """At least 0. Rows of weight 0 are padding."""


class Positions(NamedTuple):
    """Measured positions of cameras, in the order of the photos."""

    xyz: Float[Array, "c 3"]
    """In the world; finite also where the weight is 0."""
    weight: Float[Array, " c"]
    """At least 0, pixels^2 for each squared unit of length: a position that is off by its own
    deviation counts as much as a keypoint that is off by its own. 0 where none was measured."""
    scale: Float[Array, ""]
    """Of their robust loss, pixels, as that of keypoints."""


class Problem(NamedTuple):
    """The data of a cost."""

    layout: Layout
    xy: Float[Array, "s b 2"]
    weight: Float[Array, "s b"]
    sharpness: Float[Array, ""]
    """1 / scale^2 of the robust loss; 0 for least squares."""
    positions: Positions | None = None


def robust(squared: Array, sharpness: Array, loss: Loss) -> Array:
    """The loss of squared distances; they themselves where the scale is infinite."""
    x = squared * sharpness
    by = jnp.where(sharpness > 0, sharpness, 1.0).astype(x.dtype)
    if loss == "cauchy":
        return jnp.where(sharpness > 0, jnp.log1p(x) / by, squared)
    return jnp.where(x > 1, (2 * jnp.sqrt(jnp.maximum(x, 1.0)) - 1) / by, squared)


class Normal(NamedTuple):
    """The cost at a scene, and its quadratic model."""

    cost: Float[Array, ""]
    photos: Float[Array, "c f f"]
    mixed: Float[Array, "s b 3 d"]
    border: Float[Array, "p 3 b"] | None
    """The mixed blocks of points and cameras if these are a border."""
    points: Float[Array, "p 3 3"]
    slope: tuple[Float[Array, " z"], Float[Array, "p 3"]]  # of poses and cameras, and of points


def _rows(
    scene: Scene, problem: Problem, photo: Array, point: Array, weight: Array
) -> tuple[Array, ...]:
    """What the projections of some rows depend on; rows are the first axis. Those without weight
    see a point before the photo, because others may have no projection."""
    dtype, layout, seen = scene.params.dtype, problem.layout, weight[:, None] > 0
    (rotations, translations), free, of = scene.poses, layout.free, layout.camera[photo]
    numbers, fisheye = numbers_of(scene.params, layout.model)
    ways = jnp.where(free.params[:, None], spread(layout.model, dtype), 0.0)[:, :, layout.columns]
    still = free.poses[photo].astype(dtype), free.points[point].astype(dtype)
    eye = jnp.eye(4, dtype=dtype)
    x = jnp.where(seen, scene.points[point], eye[2])
    r = jnp.where(seen[..., None], rotations[photo], eye[:3, :3])
    return r, translations[photo], x, numbers[of], fisheye[of], ways[of], *still


def cost(scene: Scene, problem: Problem, loss: Loss) -> Float[Array, ""]:
    """Half the sum of weight times robust loss, pixels^2, as Ceres counts. Positions count too."""
    photo, point, xy, weight = _flat(problem)
    r, t, x, numbers, fisheye, *_ = (
        jnp.moveaxis(x, 0, -1) for x in _rows(scene, problem, photo, point, weight)
    )
    left = projected(numbers, fisheye, (r * x[:3]).sum(1) + t * x[3]) - xy.T
    found = jnp.sum(weight * robust(jnp.sum(left**2, axis=0), problem.sharpness, loss)) / 2
    if problem.positions is None:
        return found
    origin = jnp.zeros(6, found.dtype)
    of = jax.vmap(functools.partial(_position_cost, origin, loss=loss))
    return found + jnp.sum(of(*_position_rows(scene, problem)))


def _flat(problem: Problem) -> list[Array]:
    """Photo, point, keypoint and weight of each row."""
    steps = problem.layout.photo, problem.layout.point, problem.xy, problem.weight
    return [x.reshape(-1, *x.shape[2:]) for x in steps]


def _jacobian(
    rows: tuple, xy: Array, weight: Array, sharpness: Array, loss: Loss
) -> tuple[Array, Array]:
    """The cost of each row, and derivatives (2, d + 3) and its residual, weighted for least
    squares."""
    # With rows as the last axis, processors work on many at once.
    r, t, x, numbers, fisheye, ways, pose_free, point_free = (jnp.moveaxis(x, 0, -1) for x in rows)
    seen = (r * x[:3]).sum(1)
    ray = seen + t * x[3]
    slope = slopes_of_rays(numbers, fisheye, ray, ways.swapaxes(0, 1))
    own, by = slope[:-3], slope[-3:]
    turn = jnp.cross(seen[:, None], by, axis=0)
    pose = jnp.concatenate([turn, x[3] * by]) * pose_free[:, None]
    place = jnp.concatenate([(by[:, None] * r[:, :, None]).sum(0), (by * t[:, None]).sum(0)[None]])
    v = x.at[3].add(jnp.where(x[3] >= 0, 1.0, -1.0).astype(x.dtype))  # the reflection of `across`
    place = place - 2 / (v * v).sum(0) * (place * v[:, None]).sum(0) * v[:, None]
    left = projected(numbers, fisheye, ray) - xy.T
    found = _reweighting(left, sharpness, loss)
    columns = jnp.concatenate([pose, own, place[:3] * point_free])
    return _reweighted(columns, left, weight, found)


def _reweighting(left: Array, sharpness: Array, loss: Loss) -> tuple[Array, ...]:
    """Of residuals (m, n): their losses, their influence, the root of the share of it that the
    second derivative has along each residual, and the residuals' directions."""
    squared = jnp.sum(left**2, axis=0)
    costs, influence, bend = _influence(squared, sharpness, loss)
    # Along its residual, the loss of a row is flatter than across: its second derivative there is
    # a share of the influence (Triggs' correction, appendix 3).
    along = jnp.sqrt(jnp.maximum(1 + 2 * squared * bend / influence, FLATTEST))
    by = left / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    return costs, influence, along, by


def _reweighted(
    columns: Array, left: Array, weight: Array, found: tuple[Array, ...]
) -> tuple[Array, Array]:
    """The costs of residuals (m, n), and their derivatives (k, m, n) with the residuals after them,
    weighted for least squares (n, m, k + 1)."""
    costs, influence, along, by = found
    columns = columns + (along - 1) * (columns * by).sum(1, keepdims=True) * by
    columns = jnp.concatenate([columns, left[None] / along])
    return weight * costs / 2, (columns * jnp.sqrt(weight * influence)).T


def _influence(squared: Array, sharpness: Array, loss: Loss) -> tuple[Array, Array, Array]:
    """The loss of squared distances, and its first and second derivatives in them."""
    x = squared * sharpness
    if loss == "cauchy":
        influence = 1 / (1 + x)
        bend = -sharpness * influence**2
    else:
        root = lax.rsqrt(jnp.maximum(x, 1.0))
        influence, bend = root, jnp.where(x > 1, -sharpness * root**3 / 2, 0.0)
    return robust(squared, sharpness, loss), influence, bend


def turned(by: Float[Array, "*n 3"], x: Float[Array, "*m 3"]) -> Float[Array, "*m 3"]:
    """x after a rotation that is, to first order, that of the rotation vector `by` (Cayley's)."""
    half = by / 2
    once = jnp.cross(half, x)
    return x + 2 / (1 + squared_norm(half)[..., None]) * (once + jnp.cross(half, once))


def _row_cost(step: Array, rows: tuple, xy: Array, weight: Array, sharpness: Array, loss: Loss):
    """The cost of one row after a step of its photo and its point."""
    r, t, x, numbers, fisheye, ways, pose_free, point_free = rows
    pose, own, place = step[:6] * pose_free, step[6:-3], step[-3:] * point_free
    x = x + (across(x) * place).sum(1)
    ray = turned(pose[:3], (r * x[:3]).sum(1)) + (t + pose[3:]) * x[3]
    left = projected(numbers + (ways * own).sum(1), fisheye, ray) - xy
    return weight * robust(jnp.sum(left**2), sharpness, loss) / 2


def _position_rows(scene: Scene, problem: Problem) -> tuple[Array, ...]:
    """What the residuals of positions depend on; photos are the first axis. A residual is where
    the photo has the position in its own coordinates: as far from 0 as the camera is from it."""
    assert problem.positions is not None
    (rotations, translations), (xyz, weight, scale) = scene.poses, problem.positions
    seen = (rotations * xyz[:, None]).sum(-1)
    sharpness = jnp.broadcast_to(scale**-2, weight.shape)
    free = problem.layout.free.poses.astype(weight.dtype)
    return seen, translations, free, weight, sharpness


def _position_cost(step: Array, seen, translation, free, weight, sharpness, *, loss: Loss) -> Array:
    """The cost of one position after a step of its photo."""
    pose = step * free
    left = turned(pose[:3], seen) + translation + pose[3:]
    return robust(weight * squared_norm(left), sharpness, loss) / 2


def _with_positions(
    sums: list[Array], costs: Array, scene: Scene, problem: Problem, loss: Loss, exact: bool
) -> tuple[list[Array], Array]:
    """The sums of `normal` over rows, with what positions add: they touch photos only."""
    rows = _position_rows(scene, problem)
    seen, translations, free, weight, sharpness = rows
    if exact:
        origin = jnp.zeros(6, weight.dtype)
        of = functools.partial(_position_cost, loss=loss)
        own = [
            jax.vmap(lambda *row, f=f: f(of)(origin, *row))(*rows)
            for f in (lambda f: f, jax.grad, jax.hessian)
        ]
        cost_of, slope, hessian = own
    else:
        eye = jnp.broadcast_to(jnp.eye(3, dtype=weight.dtype)[..., None], (3, 3, len(weight)))
        turn = jnp.cross(eye, seen.T[None], axis=1)  # each row is a number of the step
        columns = jnp.concatenate([turn, eye]) * free.T[:, None] * jnp.sqrt(weight)
        left = (seen + translations).T * jnp.sqrt(weight)
        found = _reweighting(left, sharpness, loss)
        cost_of, wide = _reweighted(columns, left, jnp.ones_like(weight), found)
        square = jnp.einsum("nki,nkj->nij", wide, wide, precision=HIGHEST)
        hessian, slope = square[:, :-1, :-1], square[:, :-1, -1]
    photos, points, slopes_of, rest = sums
    sums = [photos.at[:, :6, :6].add(hessian), points, slopes_of.at[:, :6].add(slope), rest]
    return sums, costs + jnp.sum(cost_of)


def normal(scene: Scene, problem: Problem, loss: Loss, *, exact: bool) -> Normal:
    """The cost and its quadratic model. If it is not `exact`, its second derivatives are those of
    Gauss and Newton, with those of the robust loss down to `FLATTEST`. Slopes are exact."""
    layout, f = problem.layout, 6 + len(problem.layout.columns)
    d, dtype = 6 + len(layout.own), problem.xy.dtype

    def one(k, state):
        sums, border, costs, kept = state
        photo, point, xy, weight = (x[k] for x in given)
        rows = _rows(scene, problem, photo, point, weight)
        if exact:
            origin = jnp.zeros(f + 3, dtype)

            def each(f):
                return jax.vmap(lambda *row: f(origin, *row, problem.sharpness, loss))

            hessian = each(jax.hessian(_row_cost))(rows, xy, weight)
            costs_of, slope = each(jax.value_and_grad(_row_cost))(rows, xy, weight)
        else:
            costs_of, rows = _jacobian(rows, xy, weight, problem.sharpness, loss)
            rows = lax.optimization_barrier(rows)  # or they are computed anew for each product
            square = jnp.einsum("bki,bkj->bij", rows, rows, precision=HIGHEST)
            hessian, slope = square[:, :-1, :-1], square[:, :-1, -1]
        parts = hessian[:, :f, :f], hessian[:, f:, f:], slope[:, :f], slope[:, f:]
        to = photo, point, photo, point
        sums = [x.at[k].add(part) for x, k, part in zip(sums, to, parts, strict=True)]
        if border is not None:
            border = border.at[point, :, layout.camera[photo]].add(hessian[:, f:, d:f])
        return sums, border, costs + jnp.sum(costs_of), kept.at[k].set(hessian[:, f:, :d])

    c, p, cameras = len(layout.camera), len(scene.points), len(layout.model)
    shapes = (c, f, f), (p, 3, 3), (c, f), (p, 3)
    zeros = [jnp.zeros(shape, dtype) for shape in shapes]
    border = jnp.zeros((p, 3, cameras, f - d), dtype) if d < f else None
    given = layout.photo, layout.point, problem.xy, problem.weight
    nothing = jnp.zeros((), dtype), jnp.zeros((*layout.photo.shape, 3, d), dtype)
    sums, border, costs, mixed = lax.fori_loop(0, layout.used[0], one, (zeros, border, *nothing))
    if problem.positions is not None:
        sums, costs = _with_positions(sums, costs, scene, problem, loss, exact)
    photos, points, *slope = sums
    border = None if border is None else border.reshape(p, 3, -1)
    slopes = gathered(slope[0], layout), slope[1]
    return Normal(costs, photos, mixed, border, points, slopes)


def slope_of(scene: Scene, problem: Problem, loss: Loss) -> tuple[Array, Array]:
    """The slope of `Normal`. It has derivatives in the scene and the problem."""
    layout, sharpness = problem.layout, problem.sharpness
    photo, point, xy, weight = _flat(problem)
    rows = _rows(scene, problem, photo, point, weight), xy, weight
    origin = jnp.zeros(9 + len(layout.columns), scene.points.dtype)
    by = jax.vmap(lambda *row: jax.grad(_row_cost)(origin, *row, sharpness, loss))(*rows)
    photos = jax.ops.segment_sum(by[:, :-3], photo, len(layout.camera))
    if problem.positions is not None:
        still = jnp.zeros(6, scene.points.dtype)
        of = jax.grad(functools.partial(_position_cost, loss=loss))
        own = jax.vmap(lambda *row: of(still, *row))
        photos = photos.at[:, :6].add(own(*_position_rows(scene, problem)))
    return gathered(photos, layout), jax.ops.segment_sum(by[:, -3:], point, len(scene.points))
