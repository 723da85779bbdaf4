"""What a bundle adjustment works on, its cost, and the quadratic model of the cost.

A row is one keypoint of one photo and one point. Which rows belong together is known before any
program runs, so lists of them are made once, with numpy.

A photo has d numbers: a rotation vector, a translation, and those parameters of its camera that
move. A point has three: directions at right angles to its homogeneous vector. All photos and
cameras together have z numbers.
"""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.cameras import numbers_of, projected, slopes, spread
from jaxsfm.core.numerics import HIGHEST, across, squared_norm, unit

CHUNK = 2048
"""Rows that are linearised at once. A chunk's arrays stay in the cache: 31,843 rows take 33 ms, and
70 ms all at once."""
TOGETHER, STEP = 8, 128
"""Pairs of rows that one product sums, and products at once. 120,000 pairs take 17 ms so, and 60 ms
without steps."""
MOST_PHOTOS = 300
"""So many photos or fewer have a dense reduced system."""
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


class Free(NamedTuple):
    """What may move; everything else is held."""

    poses: Bool[Array, "c 6"]
    """Three numbers of the rotation, which move together, and three of the translation."""
    points: Bool[Array, " p"]
    params: Bool[Array, "k 8"]


class Layout(NamedTuple):
    """Which rows belong together (`layout_of`). Rows are in steps of one length. Those that fill
    the last step belong to the first photo and the first point, and weigh nothing."""

    photo: Int[Array, "s b"]
    point: Int[Array, "s b"]
    camera: Int[Array, " c"]
    """The camera of each photo: a row of `Scene.params`."""
    model: Int[Array, " k"]
    free: Free
    columns: Int[Array, " m"]
    """The columns of `Scene.params` that move for any camera."""
    pairs: tuple[Int[Array, "t u 2 8"], Int[Array, "t u"]] | None
    """Pairs of rows of one point, eight for each product, and the block of the matrix of all photos
    that the product belongs to. None if the reduced system is not formed."""


class Problem(NamedTuple):
    """The data of a cost."""

    layout: Layout
    xy: Float[Array, "s b 2"]
    weight: Float[Array, "s b"]
    sharpness: Float[Array, ""]
    """1 / scale^2 of the robust loss; 0 for least squares."""


def layout_of(
    photo: Int[np.ndarray, " n"],
    point: Int[np.ndarray, " n"],
    free: Free,
    *,
    camera: Int[np.ndarray, " c"],
    model: Int[np.ndarray, " k"],
    dense: bool | None = None,
) -> Layout:
    """The layout of rows, made on the host (numpy). The sizes of the scene are those of `free`.

    Args:
      photo, point: of each row.
      camera: of each photo.
      model: of each camera (`jaxsfm.core.cameras.intrinsics_of`).
      dense: whether the reduced system is a matrix; by default up to `MOST_PHOTOS` photos.

    Raises:
      ValueError: an index is out of range.
    """
    photos, points, cameras = (len(x) for x in free)
    given = {"photo": (photo, photos), "point": (point, points), "camera": (camera, cameras)}
    for name, (index, end) in given.items():
        if len(index) and not (0 <= np.min(index) and np.max(index) < end):
            raise ValueError(f"{name} must be in 0 to {end - 1}, but has {np.max(index)}")
    photo, point, camera, model = (np.asarray(x, np.int32) for x in (photo, point, camera, model))
    chunk = max(min(CHUNK, len(photo)), 1)
    end = -(-len(photo) // chunk) * chunk
    one, other = (np.pad(x, (0, end - len(x))).reshape(-1, chunk) for x in (photo, point))
    columns = np.flatnonzero(np.asarray(free.params).any(0)).astype(np.int32)
    dense = photos <= MOST_PHOTOS if dense is None else dense
    pairs = _pairs(photo, point, photos, nothing=end) if dense else None
    arrays: tuple[Any, ...] = one, other, camera, model, free, columns, pairs  # of numpy still
    return Layout(*arrays)


def _pairs(photo: np.ndarray, point: np.ndarray, photos: int, *, nothing: int) -> tuple:
    """Every pair of rows of one point once, by the block of their photos; `nothing` is padding."""
    order = np.argsort(point, kind="stable")
    _, first, count = np.unique(point[order], return_index=True, return_counts=True)
    after = np.repeat(first + count, count) - np.arange(len(order)) - 1
    one = np.repeat(np.arange(len(order)), after)
    other = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(after) - after, after)
    both = order[np.stack([one, other], axis=1)]
    block = photo[both] @ [photos, 1]
    by_block = np.argsort(block, kind="stable")
    block, first, count = np.unique(block[by_block], return_index=True, return_counts=True)
    products = -(-count // TOGETHER)
    within = np.arange(len(both)) - np.repeat(first, count)
    at = np.repeat(np.cumsum(products) - products, count) + within // TOGETHER
    step = max(min(STEP, products.sum()), 1)
    end = max(-(-products.sum() // step), 1) * step
    rows, blocks = np.full((end, 2, TOGETHER), nothing, np.int32), np.zeros(end, np.int32)
    rows[at, :, within % TOGETHER] = both[by_block]
    blocks[: products.sum()] = np.repeat(block, products)
    return rows.reshape(-1, step, 2, TOGETHER), blocks.reshape(-1, step)


def robust(squared: Array, sharpness: Array, loss: Loss) -> Array:
    """The loss of squared distances; they themselves where the scale is infinite."""
    x = squared * sharpness
    by = jnp.where(sharpness > 0, sharpness, 1.0).astype(x.dtype)
    if loss == "cauchy":
        return jnp.where(sharpness > 0, jnp.log1p(x) / by, squared)
    return jnp.where(x > 1, (2 * jnp.sqrt(jnp.maximum(x, 1.0)) - 1) / by, squared)


def places(layout: Layout) -> Int[Array, "c d"]:
    """Where the d numbers of each photo are among all z: six of its pose, and those of its camera,
    which come after all poses."""
    photos, columns = len(layout.camera), len(layout.columns)
    pose = jnp.arange(6 * photos, dtype=jnp.int32).reshape(photos, 6)
    own = layout.camera[:, None] * columns + jnp.arange(columns, dtype=jnp.int32)
    return jnp.concatenate([pose, 6 * photos + own], axis=1)


def gathered(x: Float[Array, "c d"], layout: Layout) -> Float[Array, " z"]:
    """All numbers from those of each photo: sums over the photos of each camera."""
    size = 6 * len(layout.camera) + len(layout.model) * len(layout.columns)
    return jnp.zeros(size, x.dtype).at[places(layout)].add(x)


def turned(by: Float[Array, "*n 3"], x: Float[Array, "*m 3"]) -> Float[Array, "*m 3"]:
    """x after a rotation that is, to first order, that of the rotation vector `by` (Cayley's)."""
    half = by / 2
    once = jnp.cross(half, x)
    return x + 2 / (1 + squared_norm(half)[..., None]) * (once + jnp.cross(half, once))


def moved(
    scene: Scene, layout: Layout, cameras: Float[Array, " z"], points: Float[Array, "p 3"]
) -> Scene:
    """The scene after a step; what is held stays as it is."""
    (rotations, translations), homogeneous, params = scene
    end, free = translations.size * 2, layout.free
    by = jnp.where(free.poses, cameras[:end].reshape(-1, 6), 0.0)
    rotations = turned(by[:, None, :3], rotations.mT).mT
    # Products of many rotations drift away from rotations; this brings them back.
    square = (rotations[:, :, None] * rotations[:, None]).sum(-1)
    rotations = 1.5 * rotations - 0.5 * (square[..., None] * rotations[:, None]).sum(2)
    shift = cameras[end:].reshape(len(params), -1)
    shift = jnp.where(free.params[:, layout.columns], shift, 0.0)
    by_points = jnp.where(free.points[:, None], points, 0.0)[:, None]
    to = unit(
        homogeneous
        + (jnp.vectorize(across, signature="(n)->(n,m)")(homogeneous) * by_points).sum(-1)
    )
    params = params.at[:, layout.columns].add(shift)
    return Scene(Poses(rotations, translations + by[:, 3:]), to, params)


class Normal(NamedTuple):
    """The quadratic model of the cost at a scene."""

    photos: Float[Array, "c d d"]
    mixed: Float[Array, "s b 3 d"]
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
    """Half the sum of weight times robust loss, pixels^2, as Ceres counts."""
    photo, point, xy, weight = _flat(problem)
    r, t, x, numbers, fisheye, *_ = (
        jnp.moveaxis(x, 0, -1) for x in _rows(scene, problem, photo, point, weight)
    )
    left = projected(numbers, fisheye, (r * x[:3]).sum(1) + t * x[3]) - xy.T
    return jnp.sum(weight * robust(jnp.sum(left**2, axis=0), problem.sharpness, loss)) / 2


def _flat(problem: Problem) -> list[Array]:
    """Photo, point, keypoint and weight of each row."""
    steps = problem.layout.photo, problem.layout.point, problem.xy, problem.weight
    return [x.reshape(-1, *x.shape[2:]) for x in steps]


def _jacobian(rows: tuple, xy: Array, weight: Array, sharpness: Array, loss: Loss) -> Array:
    """Derivatives (2, d + 3) of each row and its residual, weighted for least squares. The chain
    rule is closed; forward mode through all of it takes five times as long."""
    # With rows as the last axis, processors work on many at once.
    r, t, x, numbers, fisheye, ways, pose_free, point_free = (jnp.moveaxis(x, 0, -1) for x in rows)
    seen = (r * x[:3]).sum(1)
    ray = seen + t * x[3]
    slope = slopes(numbers, fisheye, ray, ways.swapaxes(0, 1))
    own, by = slope[:-3], slope[-3:]
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
            rows = _jacobian(rows, xy, weight, problem.sharpness, loss)
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
    photo, point, xy, weight = _flat(problem)
    rows = _rows(scene, problem, photo, point, weight), xy, weight
    origin = jnp.zeros(9 + len(layout.columns), scene.points.dtype)
    by = jax.vmap(lambda *row: jax.grad(_row_cost)(origin, *row, sharpness, loss))(*rows)
    photos = jax.ops.segment_sum(by[:, :-3], photo, len(layout.camera))
    return gathered(photos, layout), jax.ops.segment_sum(by[:, -3:], point, len(scene.points))
