"""The steps of bundle adjustment: derivatives of the cost, and the linear system that they give.

A step of a camera has six numbers: a rotation vector and a translation. A step of a point has
three: directions at right angles to its homogeneous vector. The first camera does not move, and the
second one stays at its distance from the first. Numbers that may not change have a row of zeros in
the Hessian.

Points are eliminated first (the Schur complement), so the system has the size of the cameras.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.numerics import HIGHEST, across, unit

einsum = functools.partial(jnp.einsum, precision=HIGHEST)
triangular_solve = functools.partial(lax.linalg.triangular_solve, left_side=True, lower=True)


class Scene(NamedTuple):
    """Poses and points in the frame of the first camera; the second camera has |t| = 1."""

    rotations: Float[Array, "c 3 3"]
    translations: Float[Array, "c 3"]
    points: Float[Array, "p 4"]
    """Homogeneous, of length 1."""


class Measured(NamedTuple):
    """What the cost of a scene depends on, beside the scene."""

    intrinsics: Float[Array, "c 3 3"]
    xy: Float[Array, "c p 2"]
    """Keypoints, pixels."""
    weight: Float[Array, "c p"]
    sharpness: Float[Array, ""]
    """1 / scale^2 of the robust loss; 0 for least squares."""


class Step(NamedTuple):
    """A step towards the minimum."""

    cameras: Float[Array, "c 6"]
    points: Float[Array, "p 3"]
    squared: Float[Array, ""]
    """The weighted sum of squared shifts of the projections, pixels^2."""
    determined: Bool[Array, " p"]
    """Which points the observations determine. Others stay, and do not count."""
    solved: Bool[Array, ""]
    """Whether the observations determine the cameras."""


def residuals(scene: Scene, measured: Measured) -> Float[Array, "c p 2"]:
    """Projections minus keypoints, pixels."""
    over_points = jax.vmap(_residual, (None, None, None, 0, 0))
    over_cameras = jax.vmap(over_points, (0, 0, 0, None, 0))
    return over_cameras(*scene[:2], measured.intrinsics, scene.points, measured.xy)


def derivatives(
    scene: Scene, measured: Measured, *, exact: bool
) -> tuple[Float[Array, "c p 9"], Float[Array, "c p 9 9"]]:
    """Gradient and Hessian of half the cost of each keypoint, in the steps of its camera (6) and of
    its point (3). If not `exact`, the Hessian is that of Gauss and Newton."""

    def one(camera, place, xy, weight):
        (rotation, translation, basis, k), (point, tangent) = camera, place
        origin = jnp.zeros(9, xy.dtype)

        def residual(step):
            by = einsum("ij,j->i", basis, step[:6])
            there = point + einsum("ij,j->i", tangent, step[6:])
            turned = einsum("ij,jk->ik", _rotation(by[:3]), rotation)
            return _residual(turned, translation + by[3:], k, there, xy)

        def half_cost(step):
            return 0.5 * _cost(weight, jnp.sum(residual(step) ** 2), measured.sharpness)

        if exact:
            return jax.grad(half_cost)(origin), jax.hessian(half_cost)(origin)
        here, slopes = residual(origin), jax.jacfwd(residual)(origin)
        influence = weight / (1 + measured.sharpness * jnp.sum(here**2)) ** 2
        weighted = influence * slopes
        return einsum("ki,k->i", weighted, here), einsum("ki,kj->ij", weighted, slopes)

    over_cameras = jax.vmap(jax.vmap(one, (None, 0, 0, 0)), (0, None, 0, 0))
    free, tangents = _camera_basis(scene.translations), jax.vmap(across)(scene.points)
    cameras = scene.rotations, scene.translations, free, measured.intrinsics
    return over_cameras(cameras, (scene.points, tangents), measured.xy, measured.weight)


def solve(
    gradients: Float[Array, "c p 9"],
    hessians: Float[Array, "c p 9 9"],
    *,
    damping: Float[Array, ""] | float = 0.0,
) -> Step:
    """The step -(H + damping diag(H))^-1 g. It is linear in the gradients."""
    c = len(hessians)
    own = hessians[..., 6:, 6:].sum(0)
    lower, determined = _cholesky(own, own, damping)
    gradients = jnp.where(determined[:, None], gradients, 0.0)
    hessians = jnp.where(determined[:, None, None], hessians, 0.0)
    mixed = hessians[..., 6:, :6].transpose(1, 2, 0, 3).reshape(-1, 3, 6 * c)
    right = jnp.concatenate([mixed, gradients[..., 6:].sum(0)[..., None]], axis=-1)
    right = triangular_solve(lower, right)
    known = einsum("pik,pil->kl", right, right)
    diagonal = jnp.eye(c, dtype=own.dtype)[:, None, :, None]
    blocks = (hessians[..., :6, :6].sum(1)[:, :, None] * diagonal).reshape(6 * c, 6 * c)
    factor, solved = _cholesky(blocks, blocks - known[:-1, :-1], damping)
    down = gradients[..., :6].sum(1).reshape(-1, 1) - known[:-1, -1:]
    down = triangular_solve(factor, down)
    cameras = -triangular_solve(factor, down, transpose_a=True)
    along = right[..., -1:] + einsum("pik,kl->pil", right[..., :-1], cameras)
    points = -triangular_solve(lower, along, transpose_a=True)[..., 0]
    squared = jnp.sum(down**2) + known[-1, -1]
    return Step(cameras.reshape(c, 6), points, squared, determined, solved)


def moved(scene: Scene, cameras: Float[Array, "c 6"], points: Float[Array, "p 3"]) -> Scene:
    """The scene after a step."""
    by = einsum("cij,cj->ci", _camera_basis(scene.translations), cameras)
    rotations = einsum("cij,cjk->cik", jax.vmap(_rotation)(by[:, :3]), scene.rotations)
    # Products of many rotations drift away from rotations; this brings them back.
    square = einsum("cki,ckj->cij", rotations, rotations)
    rotations = 1.5 * rotations - 0.5 * einsum("cij,cjk->cik", rotations, square)
    translations = scene.translations + by[:, 3:]
    translations = translations.at[1].set(unit(translations[1]))
    to = scene.points + einsum("pij,pj->pi", jax.vmap(across)(scene.points), points)
    return Scene(rotations, translations, unit(to))


def levenberg_marquardt(scene: Scene, measured: Measured, *, steps: Int[Array, ""] | int) -> Scene:
    """The scene after at most so many steps, none of which raises the cost."""

    def cost(scene):
        squared = jnp.sum(residuals(scene, measured) ** 2, axis=-1)
        return jnp.sum(_cost(measured.weight, squared, measured.sharpness))

    # This is the sum for shifts of sqrt(eps) pixels.
    enough = jnp.finfo(scene.points.dtype).eps * jnp.sum(measured.weight)

    def more(state):
        *_, squared, count = state
        return (count < steps) & (squared > enough)

    def one_step(state):
        scene, least, damping, _, count = state
        step = solve(*derivatives(scene, measured, exact=False), damping=damping)
        there = moved(scene, step.cameras, step.points)
        error = cost(there)
        better = step.solved & (error <= least)
        scene = jax.tree.map(lambda new, old: jnp.where(better, new, old), there, scene)
        damping = damping * jnp.where(better, 0.1, 10.0).astype(damping.dtype)
        squared = jnp.where(step.solved, step.squared, jnp.inf)
        return scene, jnp.where(better, error, least), damping, squared, count + 1

    numbers = (jnp.asarray(x, scene.points.dtype) for x in (1e-3, jnp.inf))
    return lax.while_loop(more, one_step, (scene, cost(scene), *numbers, jnp.int32(0)))[0]


def _cost(weight: Array, squared: Array, sharpness: Array) -> Array:
    """The robust loss of Geman and McClure, of squared distances."""
    return weight * squared / (1 + sharpness * squared)


def _residual(rotation: Array, translation: Array, k: Array, point: Array, xy: Array) -> Array:
    seen = einsum("ij,j->i", rotation, point[:3]) + translation * point[3]
    x, y, z = einsum("ij,j->i", k, seen)
    z = jnp.where(jnp.abs(z) > 1e-6, z, 1e-6)  # a point in the camera's plane has no projection
    return jnp.stack([x, y]) / z - xy


def _cholesky(whole: Array, matrix: Array, damping: Array | float) -> tuple[Array, Array]:
    """The lower factor of matrix + damping diag(whole), and whether it determines every number; if
    not, the identity. Numbers that may not change get a diagonal of 1."""
    diagonal = jnp.diagonal(whole, axis1=-2, axis2=-1)
    eye = jnp.eye(whole.shape[-1], dtype=whole.dtype)
    more = jnp.where(diagonal == 0, 1.0, damping * diagonal)
    lower = lax.linalg.cholesky(matrix + more[..., None] * eye)
    # A pivot is what is known of a number while those before it are free. If it is below this share
    # of what is known while they are held, it is rounding (1e-4 in float32; scenes have 2.5e-4).
    share = 0.3 * float(jnp.finfo(whole.dtype).eps) ** 0.5
    least = jnp.maximum(diagonal, share * diagonal.max(-1, keepdims=True)) * share
    pivots = jnp.diagonal(lower, axis1=-2, axis2=-1) ** 2
    determined = jnp.all((pivots > least) | (diagonal == 0), axis=-1)
    return jnp.where(determined[..., None, None], lower, eye), determined


def _camera_basis(translations: Float[Array, "c 3"]) -> Float[Array, "c 6 6"]:
    """How cameras move: the first not at all, the second at right angles to its translation."""
    basis = jnp.zeros((len(translations), 6, 6), translations.dtype)
    basis = basis.at[1:].set(jnp.eye(6, dtype=basis.dtype)).at[1, :, 5].set(0.0)
    return basis.at[1, 3:, 3:5].set(across(translations[1]))


def _rotation(by: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """A rotation that is, to first order, that of the rotation vector `by` (Cayley's map)."""
    half, eye = by / 2, jnp.eye(3, dtype=by.dtype)
    square, cross = jnp.sum(half**2), jnp.cross(eye, half)
    return eye + 2 / (1 + square) * (cross + half[:, None] * half - square * eye)
