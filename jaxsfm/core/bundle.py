"""Bundle adjustment with gradients: a loss of the poses reaches the keypoints.

At the adjusted scene the slope g of the cost is zero. By the implicit function theorem, the scene
moves with the keypoints by dx = -H^-1 dg, where H is the Hessian of the cost. So the gradient does
not go through the steps of the iteration, and costs one more solution with the factor of H. H has
the second derivatives of the residuals too: without them, the gradient would be wrong wherever
keypoints do not agree exactly.

Source: Triggs et al. 2000, "Bundle adjustment: a modern synthesis".
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.bundle_layout import Layout
from jaxsfm.core.bundle_problem import (
    Loss,
    Observations,
    Poses,
    Positions,
    Problem,
    Scene,
    cost,
    normal,
    slope_of,
)
from jaxsfm.core.bundle_step import moved
from jaxsfm.core.cameras import directions, numbers_of
from jaxsfm.core.levenberg_marquardt import minimise
from jaxsfm.core.numerics import HIGHEST, inverse_norm, unit
from jaxsfm.core.schur import factor, solve

CONVERGED_PX = 0.01
"""An adjustment has converged if its last Newton step moves projections by less than this (root
mean square)."""
SCALE = 10
"""The median distance of points is divided by so much. A step of a homogeneous point is then nearly
one of a point in space. Without it, a row of 49 photos takes more than 50 steps instead of 27."""


class Adjustment(NamedTuple):
    """An adjusted scene."""

    scene: Scene
    cost: Float[Array, ""]
    """Half the sum of weight times loss, pixels^2, as Ceres counts. It has no gradient."""
    determined: Bool[Array, " p"]
    """Whether the observations determine the point. Other points do not count in the gradient."""
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    """False if the observations do not determine what is free, or if there were too few steps. Then
    the scene is the last one found, and its gradient is zero. Photos of one place are noticed in
    float64 only, and nothing undetermined is without a matrix of the photos."""


def problem_of(
    observations: Observations, layout: Layout, *, scale: Float[Array, ""] | float
) -> Problem:
    """The rows of a layout with their keypoints. A free point that fewer than two rows see does not
    count.

    Args:
      scale: of the robust loss, pixels (`adjust`).
    """
    xy, weight = observations
    end = layout.point.size - len(weight)
    xy, weight = jnp.pad(xy, ((0, end), (0, 0))), jnp.pad(weight, (0, end))
    free, point = layout.free.points, layout.point.ravel()
    seen = jax.ops.segment_sum((weight > 0).astype(jnp.int32), point, len(free))
    weight = jnp.where(((seen > 1) | ~free)[point], weight, 0.0)
    shape, sharpness = layout.point.shape, jnp.asarray(scale, weight.dtype) ** -2
    return Problem(layout, xy.reshape(*shape, 2), weight.reshape(shape), sharpness)


def adjust(
    start: Scene,
    observations: Observations,
    layout: Layout,
    *,
    positions: Positions | None = None,
    loss: Loss = "cauchy",
    scale: Float[Array, ""] | float = math.inf,
    steps: Int[Array, ""] | int = 100,
    tolerance: Float[Array, ""] | float | None = None,
) -> Adjustment:
    """The scene that minimises half the sum of weight times loss of the squared distances, pixels,
    between keypoints and the projections of their points.

    The steps are those of Levenberg and Marquardt, and the last one is Newton's. Points are
    homogeneous, so distant ones are no difficulty. They may end behind cameras.

    The result has first derivatives in the keypoints, their weights, `scale`, and whatever of the
    scene is held. It has none in what is free: the start only says near which local minimum to
    search. The gradient needs a frame: hold seven numbers of the poses (`frame_held`) or more.
    Without one the cost is least all the same, but `converged` is false.

    Numbers are float64 if any of them is, else float32. In float32 keypoints at a thousand pixels
    are rounded to 1e-4 pixels, so poses of well-known scenes are right to about 1e-5.

    Args:
      positions: where cameras were measured. The robust loss of the distances to them is added,
        and they say where the scene as a whole lies. They have derivatives too.
      loss: Cauchy's, or Huber's.
      scale: the distance, pixels, beyond which a keypoint loses influence; above 0. By default it
        is infinite, which gives least squares. Far from the minimum, begin with that.
      steps: the largest number of steps.
      tolerance: the iteration ends where a step promises to lower the cost by less than this share.
        Then the last step is left out, and the result has no gradient.
    """
    given = jax.tree.map(jnp.asarray, (start, observations, positions))
    wide = any(x.dtype == jnp.float64 for x in jax.tree.leaves(given))
    dtype = jnp.float64 if wide else jnp.float32
    start, observations, positions = jax.tree.map(lambda x: x.astype(dtype), given)
    layout = jax.tree.map(jnp.asarray, layout)
    problem, size = problem_of(observations, layout, scale=scale), _size(start.points)
    if positions is not None:
        xyz, weight = positions.xyz / size, positions.weight * size**2
        problem = problem._replace(positions=positions._replace(xyz=xyz, weight=weight))
    start, fixed = _scaled(start, 1 / size), lax.stop_gradient(problem)
    least_gain = 0.0 if tolerance is None else tolerance
    found = minimise(lax.stop_gradient(start), fixed, loss, steps=steps, tolerance=least_gain)
    found = lax.stop_gradient(found)
    scene, poses = found.scene, layout.free.poses
    if tolerance is not None:
        every = jnp.ones(len(scene.points), bool)
        return Adjustment(_scaled(scene, size), found.model.cost, every, found.steps, found.done)
    moves = Poses(poses[:, :3].any(1)[:, None, None], poses[:, 3:])
    moves = Scene(moves, layout.free.points[:, None], layout.free.params)
    scene = jax.tree.map(jnp.where, moves, scene, start)

    # One Newton step, whose slope is a function of what was measured and whose Hessian is constant.
    # Its value is nearly zero; its derivative is the one of the implicit function.
    model = lax.stop_gradient(normal(scene, fixed, loss, exact=True))
    made = factor(model, layout, damping=0.0, tolerance=float(jnp.finfo(dtype).eps) ** 0.75)
    slope = slope_of(scene, problem, loss)
    step = solve(made, slope)
    squared = sum(jnp.sum(x * g) for x, g in zip(step, slope, strict=True))
    moving = jnp.trace(model.points, axis1=1, axis2=2) > 0
    unknown = jnp.sum(made.added == 0) + 3 * jnp.sum(moving)  # held numbers have 1 there
    known = 2 * jnp.sum(fixed.weight > 0)
    if fixed.positions is not None:
        known += 3 * jnp.sum(fixed.positions.weight > 0)
    converged = made.solved & (known >= unknown)
    converged &= jnp.abs(squared) < jnp.sum(fixed.weight) * CONVERGED_PX**2
    scene = moved(scene, layout, *(jnp.where(converged, -x, 0.0) for x in step))
    least = lax.stop_gradient(cost(scene, fixed, loss))
    determined = converged & made.determined & (moving | ~layout.free.points)
    return Adjustment(_scaled(scene, size), least, determined, found.steps, converged)


@functools.partial(jax.jit, static_argnames="loss")
def minimised(
    start: Scene,
    observations: Observations,
    layout: Layout,
    scale: Float[Array, ""],
    steps: Int[Array, ""],
    tolerance: Float[Array, ""],
    positions: Positions | None,
    *,
    loss: Loss = "cauchy",
) -> Adjustment:
    """`adjust` without gradients, as one program; its arguments are those of `adjust`."""
    how = {"scale": scale, "steps": steps, "tolerance": tolerance}
    return adjust(start, observations, layout, positions=positions, loss=loss, **how)


def _size(points: Float[Array, "p 4"]) -> Float[Array, ""]:
    """`SCALE` times the median distance of points; 1 if that is 0 or infinite."""
    distance = jnp.linalg.norm(points[:, :3], axis=1) / jnp.abs(points[:, 3])
    middle = lax.stop_gradient(jnp.sort(distance)[len(points) // 2])
    return jnp.where((middle > 0) & (middle < jnp.inf), SCALE * middle, 1.0).astype(points.dtype)


def _scaled(scene: Scene, by: Float[Array, ""]) -> Scene:
    """The same scene in other units of length; points have length 1."""
    poses = scene.poses._replace(translations=scene.poses.translations * by)
    points = unit(scene.points * jnp.stack([by, by, by, jnp.ones_like(by)]))
    return Scene(poses, points, scene.params)


def frame_held(poses: Poses) -> Bool[Array, "c 6"]:
    """Which numbers of the poses are free if the frame is held: all but those of the first pose and
    one of the second translation, the longest part of the way from the first camera."""
    way = relative_to_first(poses).translations[1]
    free = jnp.ones((len(poses.rotations), 6), bool).at[0].set(False)
    return free.at[1, 3 + jnp.argmax(jnp.abs(way))].set(False)


def relative_to_first(poses: Poses) -> Poses:
    """The same poses in the frame of the first, with the second at distance 1 from it. If these
    two are at one place, the scale is kept."""
    rotations = jnp.einsum("cij,kj->cik", poses.rotations, poses.rotations[0], precision=HIGHEST)
    rotations = rotations.at[0].set(jnp.eye(3, dtype=rotations.dtype))  # without rounding
    origin = jnp.einsum("cij,j->ci", rotations, poses.translations[0], precision=HIGHEST)
    shifts = poses.translations - origin
    scale = inverse_norm(shifts[1])
    return Poses(rotations, shifts * jnp.where(scale > 0, scale, 1.0))


def pose_loss(poses: Poses, reference: Poses) -> Float[Array, ""]:
    """How far poses are from those of a reference: the mean, over all poses but the first, of two
    squared angles (radians). These are the angle of the rotation between both poses, and the angle
    between the directions of their translations.

    Poses are relative to the first one, so neither the frame nor the scale matters. Instead of an
    angle, its chord 2 sin(angle / 2) is used, whose square is smooth at zero.
    """
    ours, theirs = relative_to_first(poses), relative_to_first(reference)
    turned = jnp.sum((ours.rotations - theirs.rotations)[1:] ** 2, axis=(1, 2)) / 2
    apart = unit(ours.translations[1:]) - unit(theirs.translations[1:])
    return jnp.mean(turned + jnp.sum(apart**2, axis=-1))


def triangulated(
    poses: Poses, params: Float[Array, "k 8"], observations: Observations, layout: Layout
) -> Float[Array, "p 4"]:
    """Homogeneous points of length 1 by the direct linear transform (Hartley and Zisserman 2004,
    section 12.2), for rays at less than 90 degrees from the axes of their cameras. They have no
    gradient."""
    photo, point = (x.ravel()[: len(observations.weight)] for x in (layout.photo, layout.point))
    numbers, fisheye = (x[layout.camera[photo]] for x in numbers_of(params, layout.model))
    uv = directions(numbers.T, fisheye, observations.xy.T).T
    pose = jnp.concatenate([poses.rotations, poses.translations[..., None]], axis=-1)[photo]
    rows = uv[..., None] * pose[:, 2:] - pose[:, :2]
    weighted = rows * observations.weight[:, None, None]
    square = jnp.einsum("nki,nkj->nij", weighted, rows, precision=HIGHEST)
    square = jax.ops.segment_sum(square, point, len(layout.free.points))
    return jnp.linalg.eigh(lax.stop_gradient(square))[1][..., 0]
