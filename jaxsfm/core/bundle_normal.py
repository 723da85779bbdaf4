"""The cost of a bundle adjustment and its quadratic model: a slope and second derivatives.

A photo has d numbers: a rotation vector, a translation, and those parameters of its camera that
move. A point has three: directions at right angles to its homogeneous vector. Each row gives a
block of its photo, one of its point and a mixed one. Only mixed blocks are kept for each row.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsfm.core.bundle_problem import Loss, Problem, Scene, gathered, robust, turned
from jaxsfm.core.cameras import numbers_of, projected, slopes, spread
from jaxsfm.core.numerics import HIGHEST, across


class Normal(NamedTuple):
    """The quadratic model of the cost at a scene."""

    photos: Float[Array, "c d d"]
    mixed: Float[Array, "s b 3 d"]
    points: Float[Array, "p 3 3"]
    slope: tuple[Float[Array, " z"], Float[Array, "p 3"]]
    """Of poses and cameras, and of points."""


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


def _long(rows: tuple[Array, ...]) -> tuple[Array, ...]:
    """The same with rows as the last axis, so that processors work on many at once."""
    return tuple(jnp.moveaxis(x, 0, -1) for x in rows)


def cost(scene: Scene, problem: Problem, loss: Loss) -> Float[Array, ""]:
    """Half the sum of weight times robust loss, pixels^2, as Ceres counts."""

    def one(total, rows):
        photo, point, xy, weight = rows
        r, t, x, numbers, fisheye, *_ = _long(_rows(scene, problem, photo, point, weight))
        left = projected(numbers, fisheye, (r * x[:3]).sum(1) + t * x[3]) - xy.T
        of_rows = robust(jnp.sum(left**2, axis=0), problem.sharpness, loss)
        return total + jnp.sum(weight * of_rows) / 2, None

    layout, zero = problem.layout, jnp.zeros((), problem.xy.dtype)
    return lax.scan(one, zero, (layout.photo, layout.point, problem.xy, problem.weight))[0]


def _jacobian(rows: tuple, xy: Array, weight: Array, sharpness: Array, loss: Loss) -> Array:
    """Derivatives (2, d + 3) of each row and its residual, weighted for least squares.

    Derivatives are closed; forward mode takes five times as long.
    """
    r, t, x, numbers, fisheye, ways, pose_free, point_free = rows
    seen = (r * x[:3]).sum(1)
    ray = seen + t * x[3]
    by_number, by = slopes(numbers, fisheye, ray)
    own = (by_number[:, None] * ways[:, :, None]).sum(0)
    turn = jnp.cross(seen[:, None], by, axis=0)
    pose = jnp.concatenate([turn, x[3] * by]) * pose_free[:, None]
    place = jnp.concatenate([(by[:, None] * r[:, :, None]).sum(0), (by * t[:, None]).sum(0)[None]])
    v = x.at[3].add(jnp.where(x[3] >= 0, 1.0, -1.0).astype(x.dtype))  # the reflection of `across`
    place = place - 2 / (v * v).sum(0) * (place * v[:, None]).sum(0) * v[:, None]
    left = projected(numbers, fisheye, ray) - xy.T
    squared = jnp.sum(left**2, axis=0)
    influence = jax.grad(lambda s: robust(s, sharpness, loss).sum())(squared)
    columns = jnp.concatenate([pose, own, place[:3] * point_free, left[None]])
    return (columns * jnp.sqrt(weight * influence)).T


def _row_cost(step: Array, rows: tuple, xy: Array, weight: Array, sharpness: Array, loss: Loss):
    """The cost of one row after a step of its photo and its point."""
    r, t, x, numbers, fisheye, ways, pose_free, point_free = rows
    pose, own, place = step[:6] * pose_free, step[6:-3], step[-3:] * point_free
    x = x + (across(x) * place).sum(1)
    ray = turned(pose[:3], (r * x[:3]).sum(1)) + (t + pose[3:]) * x[3]
    left = projected(numbers + (ways * own).sum(1), fisheye, ray) - xy
    return weight * robust(jnp.sum(left**2), sharpness, loss) / 2


def normal(scene: Scene, problem: Problem, loss: Loss, *, exact: bool) -> Normal:
    """The quadratic model. Its second derivatives are those of Gauss and Newton, with the weights
    of the robust loss, if it is not `exact`. Slopes are exact."""
    layout, d = problem.layout, 6 + len(problem.layout.columns)

    def one(sums, given):
        photo, point, xy, weight = given
        rows = _rows(scene, problem, photo, point, weight)
        if exact:
            origin = jnp.zeros(d + 3, xy.dtype)
            hessian, slope = (
                jax.vmap(lambda *row, f=f: f(origin, *row, problem.sharpness, loss))(
                    rows, xy, weight
                )
                for f in (jax.hessian(_row_cost), jax.grad(_row_cost))
            )
        else:
            rows = _jacobian(_long(rows), xy, weight, problem.sharpness, loss)
            rows = lax.optimization_barrier(rows)  # or they are computed anew for each product
            square = jnp.einsum("bki,bkj->bij", rows, rows, precision=HIGHEST)
            hessian, slope = square[:, :-1, :-1], square[:, :-1, -1]
        parts = hessian[:, :d, :d], hessian[:, d:, d:], slope[:, :d], slope[:, d:]
        to = photo, point, photo, point
        sums = [x.at[k].add(part) for x, k, part in zip(sums, to, parts, strict=True)]
        return sums, hessian[:, d:, :d]

    c, p = len(layout.camera), len(scene.points)
    zeros = [jnp.zeros(shape, problem.xy.dtype) for shape in ((c, d, d), (p, 3, 3), (c, d), (p, 3))]
    given = layout.photo, layout.point, problem.xy, problem.weight
    (photos, points, *slope), mixed = lax.scan(one, zeros, given)
    return Normal(photos, mixed, points, (gathered(slope[0], layout), slope[1]))


def slope_of(scene: Scene, problem: Problem, loss: Loss) -> tuple[Array, Array]:
    """The slope of `Normal`. It has derivatives in the scene and the problem."""
    layout, sharpness = problem.layout, problem.sharpness
    photo, point, weight = (x.ravel() for x in (layout.photo, layout.point, problem.weight))
    rows = _rows(scene, problem, photo, point, weight), problem.xy.reshape(-1, 2), weight
    origin = jnp.zeros(9 + len(layout.columns), scene.points.dtype)
    by = jax.vmap(lambda *row: jax.grad(_row_cost)(origin, *row, sharpness, loss))(*rows)
    photos = jax.ops.segment_sum(by[:, :-3], photo, len(layout.camera))
    return gathered(photos, layout), jax.ops.segment_sum(by[:, -3:], point, len(scene.points))
