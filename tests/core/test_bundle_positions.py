"""Laws of measured positions in a bundle adjustment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from strategies import rng_of
from test_bundle import Made, scene

from jaxsfm.core.bundle import adjust, minimised, problem_of
from jaxsfm.core.bundle_problem import (
    Poses,
    Positions,
    Scene,
    cost,
    normal,
    slope_of,
)
from jaxsfm.core.bundle_step import moved


def free_scene(seed: int, *, photos=5, count=30, noise=1.0) -> Made:
    """Nothing but the cameras' intrinsics is held."""
    made = scene(seed, known=True, photos=photos, count=count, noise=noise)
    loose = made.layout.free._replace(poses=np.ones((photos, 6), bool))
    made.layout = made.layout._replace(free=loose)
    return made


def measured(made: Made, *, weight=400.0, scale=np.inf, noise=0.05) -> Positions:
    """Where cameras are, up to the noise."""
    rotations, translations = made.poses
    centres = -np.einsum("cji,cj->ci", rotations, translations)
    centres += noise * rng_of(77).normal(size=centres.shape)
    return Positions(centres, np.full(len(centres), weight), np.float64(scale))


def adjusted(made: Made, positions: Positions, dtype=np.float64):
    return minimum((*made.given, positions), dtype)


def minimum(given: tuple, dtype=np.float64):
    """The adjustment of (start, observations, layout, positions)."""
    start, seen, layout, positions = jax.tree.map(
        lambda x: np.asarray(x, dtype) if np.asarray(x).dtype == np.float64 else x, given
    )
    limits = dtype(8), np.int32(100), dtype(1e-13 if dtype == np.float64 else 1e-7)
    with jax.enable_x64(dtype == np.float64):
        return jax.device_get(minimised(start, seen, layout, *limits, positions))


def centres_of(poses: Poses) -> np.ndarray:
    return -np.einsum("cji,cj->ci", poses.rotations, poses.translations)


@pytest.mark.parametrize("loss", ["cauchy", pytest.param("huber", marks=pytest.mark.slow)])
def test_the_slope_and_the_exact_model_are_those_of_central_differences(loss):
    """Along steps of photos as `moved` makes them, relative to their neighbours."""
    made = free_scene(1)
    made.weight = 0 * made.weight  # positions alone
    positions = measured(made, scale=3.0, noise=0.3)._replace(
        weight=np.asarray([90.0, 0, 9, 60, 3])
    )
    with jax.enable_x64(True):
        start, seen, layout, positions = jax.tree.map(jnp.asarray, (*made.given, positions))
        problem = problem_of(seen, layout, scale=8.0)._replace(positions=positions)

        @jax.jit
        def along(way, share):
            by = share * way, jnp.zeros((len(start.points), 3))
            return cost(moved(start, layout, *by), problem, loss)

        @jax.jit
        def models():
            both = [normal(start, problem, loss, exact=exact) for exact in (True, False)]
            return *both, slope_of(start, problem, loss), cost(start, problem, loss)

        exact, approximate, slope, value = models()
        for each in (exact, approximate):
            np.testing.assert_allclose(each.cost, value, rtol=1e-12)
            np.testing.assert_allclose(each.slope[0], slope[0], rtol=1e-9, atol=1e-9)
        for seed in range(3):
            way = jnp.asarray(rng_of(seed).normal(size=slope[0].shape))
            step = 1e-4
            near = (along(way, step) - along(way, -step)) / (2 * step)
            np.testing.assert_allclose(near, slope[0] @ way, rtol=1e-5)


def test_far_below_the_scale_the_model_is_that_of_least_squares():
    """The exact Hessian of a residual of 0 is that of Gauss and Newton."""
    made = free_scene(2)
    made.weight = 0 * made.weight
    positions = measured(made, noise=0.0)
    with jax.enable_x64(True):
        start, seen, layout, positions = jax.tree.map(jnp.asarray, (*made.given, positions))
        start = start._replace(poses=jax.tree.map(jnp.asarray, made.poses))
        problem = problem_of(seen, layout, scale=8.0)._replace(positions=positions)
        both = jax.jit(
            lambda: [normal(start, problem, "cauchy", exact=e).photos for e in (True, False)]
        )()
    np.testing.assert_allclose(*both, atol=1e-9)
    assert np.abs(both[0]).max() > 100


def test_the_optimum_is_that_of_scipy():
    """All unknowns of five photos, with pixels and positions, in least squares."""
    made = free_scene(3)
    positions = measured(made, scale=5.0)
    found = adjusted(made, positions)
    assert found.converged
    f, c = made.params[0, :2], made.params[0, 2:4]

    def unpacked(x):
        poses = x[:30].reshape(5, 6)
        turn = Rotation.from_rotvec(poses[:, :3]).as_matrix() @ made.poses.rotations
        return Poses(turn, poses[:, 3:]), x[30:].reshape(-1, 3)

    def residuals(x):
        poses, points = unpacked(x)
        rays = np.einsum("cij,pj->cpi", poses.rotations, points) + poses.translations[:, None]
        off = (f * rays[..., :2] / rays[..., 2:] + c - made.xy) / 8
        pixels = 8 * np.sqrt(made.weight)[..., None] * shrunk(off)
        away = np.sqrt(positions.weight)[:, None] * (centres_of(poses) - positions.xyz) / 5
        return np.concatenate([pixels.ravel(), 5 * shrunk(away).ravel()])

    def shrunk(x):
        """Vectors in the same direction, whose squares are Cauchy's loss."""
        squared = (x**2).sum(-1, keepdims=True)
        return x * np.sqrt(np.log1p(squared) / squared)

    x = found.scene.points
    points = x[:, :3] / x[:, 3:]
    ours = Rotation.from_matrix(found.scene.poses.rotations @ made.poses.rotations.mT)
    shifts = np.column_stack([ours.as_rotvec(), found.scene.poses.translations])
    ours = np.concatenate([shifts.ravel(), points.ravel()])
    np.testing.assert_allclose((residuals(ours) ** 2).sum() / 2, found.cost, rtol=1e-9)
    begin = ours + 1e-3 * rng_of(4).normal(size=ours.shape)
    best = least_squares(residuals, begin, ftol=1e-12, xtol=1e-12, max_nfev=50)
    assert abs(best.cost - found.cost) < 1e-6 * best.cost
    np.testing.assert_allclose(
        unpacked(best.x)[0].translations, found.scene.poses.translations, atol=1e-4
    )


def test_a_turned_shifted_and_scaled_world_has_the_turned_shifted_and_scaled_optimum():
    made = free_scene(5)
    positions = measured(made, scale=5.0)
    turn, shift, scale = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), np.arange(3.0), 7.0
    start, seen, layout = made.given
    rotations = start.poses.rotations @ turn.T
    there = scale * centres_of(start.poses) @ turn.T + shift
    poses = Poses(rotations, -np.einsum("cij,cj->ci", rotations, there))
    points = start.points[:, :3] / start.points[:, 3:]
    points = np.column_stack([scale * points @ turn.T + shift, np.ones(len(points))])
    xyz = scale * positions.xyz @ turn.T + shift
    other = positions._replace(xyz=xyz, weight=positions.weight / scale**2)
    one, two = (
        minimum(given)
        for given in (
            (start, seen, layout, positions),
            (Scene(poses, points, start.params), seen, layout, other),
        )
    )
    assert one.converged and two.converged
    np.testing.assert_allclose(two.cost, one.cost, rtol=1e-9)
    expected = scale * centres_of(one.scene.poses) @ turn.T + shift
    np.testing.assert_allclose(centres_of(two.scene.poses), expected, atol=1e-5)


def test_positions_without_weight_change_nothing():
    made = free_scene(6)
    one, other = (measured(made, weight=0.0, noise=noise) for noise in (0.0, 9.0))
    found = adjusted(made, one)
    jax.tree.map(np.testing.assert_array_equal, found, adjusted(made, other))


def test_one_wrong_position_is_outvoted():
    """It moves cameras by less than a tenth of what it does in least squares."""
    made, moved_by = free_scene(7, noise=0.1), {}
    for scale in (0.4, np.inf):
        positions = measured(made, weight=4.0, scale=scale, noise=0.02)
        right = adjusted(made, positions)
        positions.xyz[2] += [3.0, 0.0, 0.0]
        wrong = adjusted(made, positions)
        assert right.converged and wrong.converged
        shift = centres_of(wrong.scene.poses) - centres_of(right.scene.poses)
        moved_by[scale] = np.linalg.norm(shift, axis=1).max()
    assert moved_by[0.4] < 0.1 * moved_by[np.inf]


@pytest.mark.slow
def test_float32_finds_the_optimum_of_float64():
    """Up to a tenth of the deviation of a position."""
    made = free_scene(8)
    positions = measured(made, scale=5.0, weight=400.0)
    wide, single = (adjusted(made, positions, dtype) for dtype in (np.float64, np.float32))
    assert single.scene.points.dtype == np.float32
    np.testing.assert_allclose(single.cost, wide.cost, rtol=1e-4)
    np.testing.assert_allclose(*(centres_of(x.scene.poses) for x in (single, wide)), atol=0.1 / 20)


@pytest.mark.slow
def test_the_gradient_in_positions_is_that_of_central_differences():
    made = free_scene(9)
    positions, rng = measured(made, scale=5.0), rng_of(10)
    ways = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=5)
    with jax.enable_x64(True):
        start, seen, layout, positions = jax.tree.map(jnp.asarray, (*made.given, positions))

        @jax.jit
        @jax.value_and_grad
        def value(positions):
            found = adjust(start, seen, layout, positions=positions, scale=8.0)
            return jnp.sum(ways[0] * found.scene.poses.translations)

        _, slope = value(positions)
        for name, way, step in (("xyz", ways[1], 1e-3), ("weight", ways[2], 1.0)):
            at = [
                value(positions._replace(**{name: getattr(positions, name) + by * step * way}))[0]
                for by in (-1, 1)
            ]
            difference = (at[1] - at[0]) / (2 * step)
            np.testing.assert_allclose(np.sum(getattr(slope, name) * way), difference, rtol=1e-4)
