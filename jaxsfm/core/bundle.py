"""Bundle adjustment of a small scene, with gradients: a loss of the poses reaches the keypoints.

At the adjusted scene the gradient g of the cost is zero. By the implicit function theorem, the
scene moves with the keypoints by dx = -H^-1 dg, where H is the Hessian of the cost. So the gradient
does not go through the steps of the iteration. H has the second derivatives of the residuals too:
without them, the gradient would be wrong wherever keypoints do not agree exactly.

All blocks of H are held at once, so this is meant for small scenes.

Source: Triggs et al. 2000, "Bundle adjustment: a modern synthesis".
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.bundle_steps import (
    Measured,
    Scene,
    derivatives,
    einsum,
    levenberg_marquardt,
    moved,
    residuals,
    solve,
)
from jaxsfm.core.homography import homogeneous
from jaxsfm.core.numerics import inverse_norm, unit

CONVERGED_PX = 0.01
"""An adjustment has converged if its last Newton step moves projections by less than this (root
mean square)."""


class Cameras(NamedTuple):
    """Pinhole cameras: a point X of the world has the camera coordinates R X + t."""

    rotations: Float[Array, "c 3 3"]
    translations: Float[Array, "c 3"]
    intrinsics: Float[Array, "c 3 3"]
    """Pixels; (0, 0) is the centre of the top-left pixel."""


class Observations(NamedTuple):
    """The keypoint of every point in every camera. A camera is a row and a point a column, so rows
    (but not the first two) and columns of weight 0 are padding."""

    xy: Float[Array, "c p 2"]
    """Pixels; finite also where the weight is 0."""
    weight: Float[Array, "c p"]
    """At least 0; 0 where the camera does not see the point."""


class Adjustment(NamedTuple):
    """An adjusted scene. The first camera has R = I and t = 0; the second has |t| = 1."""

    cameras: Cameras
    points: Float[Array, "p 4"]
    """Homogeneous, of length 1; the last coordinate is 0 at infinity."""
    determined: Bool[Array, " p"]
    """Whether the observations determine the point. Other points do not count in the gradient."""
    error: Float[Array, ""]
    """Weighted root mean square distance of keypoints from projections, pixels. It has no
    gradient."""
    converged: Bool[Array, ""]
    """False if the observations do not determine the poses, or if there were too few steps. Then
    the scene is the last one found, and its gradient is zero."""


def adjust(
    start: Cameras,
    observations: Observations,
    *,
    scale: Float[Array, ""] | float = math.inf,
    steps: Int[Array, ""] | int = 100,
) -> Adjustment:
    """The cameras and points that minimise the sum of weight d^2 / (1 + d^2 / scale^2), where d is
    the distance, pixels, between a keypoint and the projection of its point.

    Points are triangulated from `start`. A point that fewer than two cameras see does not count.
    The steps are those of Levenberg and Marquardt, and the last one is Newton's. Points are
    homogeneous, so distant ones are no difficulty. They may end behind cameras.

    The result has first derivatives in the keypoints, their weights, the intrinsics and `scale`. It
    has none in the poses of `start`, which only say near which local minimum to search.

    Args:
      start: two cameras or more in any frame and of any scale; the first two at different places.
      scale: the distance, pixels, beyond which a keypoint loses influence (Geman and McClure's
        loss); above 0. By default it is infinite, which gives least squares.
      steps: the largest number of steps.

    Raises:
      ValueError: there are fewer than two cameras.
    """
    count = len(start.rotations)
    if count < 2:
        raise ValueError(f"bundle adjustment needs two cameras or more, but was given {count}")
    given = jax.tree.map(jnp.asarray, (start, observations))
    wide = any(x.dtype == jnp.float64 for x in jax.tree.leaves(given))
    dtype = jnp.float64 if wide else jnp.float32
    start, (xy, weight) = jax.tree.map(lambda x: x.astype(dtype), given)
    weight = jnp.where((weight > 0).sum(0, dtype=jnp.int32) > 1, weight, 0.0)
    seen = weight > 0
    measured = Measured(start.intrinsics, xy, weight, jnp.asarray(scale, weight.dtype) ** -2)
    fixed = lax.stop_gradient(measured)

    first = relative_to_first(start)
    scene = Scene(first.rotations, first.translations, _triangulated(first, xy, weight))
    scene = lax.stop_gradient(scene)
    posed = seen[:2].any(1).all() & (jnp.sum(scene.translations[1] ** 2) > 0)
    numbers, views, points = (x.sum(dtype=jnp.int32) for x in (seen, seen.any(1), seen.any(0)))
    posed &= 2 * numbers >= 6 * views + 3 * points - 7
    scene = lax.stop_gradient(levenberg_marquardt(scene, fixed, steps=steps))
    posed &= jnp.any(seen.any(0) & (scene.points[:, 3] != 0))  # points at infinity show no shift

    # One Newton step, whose gradient is a function of what was measured and whose Hessian is
    # constant. Its value is nearly zero; its derivative is the one of the implicit function.
    gradients, hessians = derivatives(scene, measured, exact=True)
    step = solve(gradients, lax.stop_gradient(hessians))
    total = jnp.maximum(jnp.sum(fixed.weight), 1e-30)
    converged = posed & step.solved & (step.squared < total * CONVERGED_PX**2)
    cameras, points = (jnp.where(converged, x, 0.0) for x in (step.cameras, step.points))
    scene = moved(scene, cameras, points)
    squared = jnp.sum(residuals(lax.stop_gradient(scene), fixed) ** 2, axis=-1)
    return Adjustment(
        Cameras(scene.rotations, scene.translations, start.intrinsics),
        scene.points,
        determined=converged & step.determined & seen.any(0),
        error=jnp.sqrt(jnp.sum(fixed.weight * squared) / total),
        converged=converged,
    )


def relative_to_first(cameras: Cameras) -> Cameras:
    """The same cameras in the frame of the first, with the second at distance 1 from it. If these
    two are at one place, the scale is kept."""
    rotations = einsum("cij,kj->cik", cameras.rotations, cameras.rotations[0])
    rotations = rotations.at[0].set(jnp.eye(3, dtype=rotations.dtype))  # without rounding
    shifts = cameras.translations - einsum("cij,j->ci", rotations, cameras.translations[0])
    factor = inverse_norm(shifts[1])
    return Cameras(rotations, shifts * jnp.where(factor > 0, factor, 1.0), cameras.intrinsics)


def pose_loss(cameras: Cameras, reference: Cameras) -> Float[Array, ""]:
    """How far the poses of cameras are from those of a reference: the mean, over all cameras but
    the first, of two squared angles (radians). These are the angle of the rotation between both
    poses, and the angle between the directions of their translations.

    Poses are relative to the first camera, so neither the frame nor the scale matters. Instead of
    an angle, its chord 2 sin(angle / 2) is used, whose square is smooth at zero.
    """
    ours, theirs = relative_to_first(cameras), relative_to_first(reference)
    turned = jnp.sum((ours.rotations - theirs.rotations)[1:] ** 2, axis=(1, 2)) / 2
    apart = unit(ours.translations[1:]) - unit(theirs.translations[1:])
    return jnp.mean(turned + jnp.sum(apart**2, axis=-1))


def _triangulated(cameras: Cameras, xy: Array, weight: Array) -> Float[Array, "p 4"]:
    """Points by the direct linear transform (Hartley and Zisserman 2004, section 12.2)."""
    rotations, translations, intrinsics = cameras
    rays = einsum("cij,cpj->cpi", jnp.linalg.inv(intrinsics), homogeneous(xy))
    poses = jnp.concatenate([rotations, translations[..., None]], axis=-1)[:, None]
    rows = rays[..., :2, None] * poses[..., 2:, :] - poses[..., :2, :]
    normal = einsum("cpki,cpkj->pij", rows * weight[..., None, None], rows)
    return jnp.linalg.eigh(normal)[1][..., 0]
