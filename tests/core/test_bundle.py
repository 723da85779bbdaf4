"""Laws of bundle adjustment and of its gradient."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import tolerances
from compiled import compiled
from scipy.spatial.transform import Rotation
from strategies import rng_of

from jaxsfm.core.bundle import Cameras, Observations, adjust, pose_loss
from jaxsfm.core.relocalize import relocalize

CAMERA = np.asarray([[400.0, 0, 320], [0, 380, 240], [0, 0, 1]])


@jax.jit
def _solved(start, seen, true, scale, steps):
    def cost(start, seen, scale):
        found = adjust(start, seen, scale=scale, steps=steps)
        count = len(true.rotations)  # cameras after these are padding
        first = jax.tree.map(lambda x: x[:count], found.cameras)
        return pose_loss(first, true), found

    return jax.value_and_grad(cost, (0, 1, 2), has_aux=True)(start, seen, scale)


def solved(start, seen, true, *, scale=np.inf, steps=100):
    """The loss of the adjusted poses, the adjustment, and the gradient of the loss with respect to
    cameras, observations and scale. It has one shape in most tests, and so it is compiled once."""
    scale = np.asarray(scale, seen.xy.dtype)
    (loss, found), slopes = _solved(start, seen, true, scale, np.int32(steps))
    return jax.device_get((loss, found, slopes))


def cameras_of(rotations, centres) -> Cameras:
    rotations = np.asarray(rotations, np.float64)
    translations = -np.einsum("cij,cj->ci", rotations, np.asarray(centres, np.float64))
    return Cameras(rotations, translations, np.stack([CAMERA] * len(rotations)))


def observations_of(cameras: Cameras, points: np.ndarray) -> Observations:
    """Exact ones; a point is homogeneous."""
    poses = np.concatenate([cameras.rotations, cameras.translations[..., None]], axis=-1)
    image = np.einsum("cij,cjk,pk->cpi", cameras.intrinsics, poses, points)
    return Observations(image[..., :2] / image[..., 2:], np.ones(image.shape[:2]))


def turns(rng, count: int, angle: float) -> np.ndarray:
    return Rotation.from_rotvec(angle * rng.normal(size=(count, 3))).as_matrix()


def scene(seed: int, *, noise: float, cameras: int = 3, points: int = 30):
    """Cameras in an arbitrary frame, a box of points before them, and noisy keypoints of it."""
    rng = rng_of(seed)
    places = np.arange(cameras)[:, None] * [1.0, 0.2, 0.1] + 0.1 * rng.normal(size=(cameras, 3))
    true = cameras_of(turns(rng, cameras, 0.1), places)
    box = np.column_stack([rng.uniform([-2, -2, 4], [4, 2, 9], (points, 3)), np.ones(points)])
    exact = observations_of(true, box)
    noisy = exact._replace(xy=exact.xy + noise * rng.normal(size=exact.xy.shape))
    return true, noisy, box


def astray(cameras: Cameras, seed: int = 9) -> Cameras:
    """Poses a few degrees and a twentieth of the baseline off."""
    rng, c = rng_of(seed), len(cameras.rotations)
    rotations = np.einsum("cij,cjk->cik", turns(rng, c, 0.03), cameras.rotations)
    moved = cameras.translations + 0.05 * rng.normal(size=(c, 3))
    return cameras._replace(rotations=rotations, translations=moved)


def single(tree):
    return jax.tree.map(lambda x: np.asarray(x, np.float32), tree)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_optimum_is_that_of_scipy(seed):
    true, seen, box = scene(seed, noise=1.0)
    seen = seen._replace(weight=rng_of(seed).uniform(0.2, 2.0, seen.weight.shape))
    seen.weight[2, :5] = 0  # the third camera does not see some points
    with jax.enable_x64(True):
        _, found, _ = solved(astray(true), seen, true)
    assert found.converged and found.determined.all()
    expected = oracles.bundle_adjustment(true, box[:, :3], *seen)
    np.testing.assert_allclose(found.cameras.rotations, expected[0], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(found.cameras.translations, expected[1], rtol=1e-6, atol=1e-7)
    points = found.points[:, :3] / found.points[:, 3:]
    np.testing.assert_allclose(points, expected[2], rtol=1e-5)
    np.testing.assert_allclose(found.error, expected[3], rtol=1e-9)
    assert 0.3 < found.error < 2


@pytest.mark.parametrize("part", ["xy", "weight", "intrinsics", "scale"])
def test_the_gradient_of_a_pose_loss_is_that_of_central_differences(part):
    """Keypoints are a pixel off, so second derivatives of the residuals count."""
    true, seen, _ = scene(2, noise=1.0)
    start, scale, step = astray(true), np.asarray(4.0), 1e-4

    def given(by):
        return (
            start._replace(intrinsics=start.intrinsics + by * (way if part == "intrinsics" else 0)),
            seen._replace(**({part: getattr(seen, part) + by * way} if part in dir(seen) else {})),
            scale + by * (way if part == "scale" else 0),
        )

    leaf = {"intrinsics": lambda g: g[0].intrinsics, "scale": lambda g: g[2]}.get(
        part, lambda g: getattr(g[1], part)
    )
    way = rng_of(3).normal(size=leaf((start, seen, scale)).shape)
    if part == "intrinsics":
        way[:, 2] = 0
    with jax.enable_x64(True):
        ahead, here, behind = (
            solved(cameras, points, true, scale=robust)
            for cameras, points, robust in map(given, (step, 0.0, -step))
        )
    assert here[1].converged and here[1].error > 0.5
    difference = (ahead[0] - behind[0]) / (2 * step)
    assert abs(difference) > 1e-6
    np.testing.assert_allclose(np.sum(leaf(here[2]) * way), difference, **tolerances.EXACT_GRADIENT)


def test_the_gradient_of_a_pose_loss_reaches_the_scores_of_walks():
    true, seen, _ = scene(4, noise=0.0)
    row, col = (jnp.asarray(x.ravel(), jnp.int32) for x in np.mgrid[:5, :6])
    step, rng = 1e-4, rng_of(5)
    with jax.enable_x64(True):
        maps = [jnp.asarray(rng.uniform(0.5, 1.5, (3, 5 << k, 6 << k))) for k in (1, 2, 3)]
        way = [jnp.asarray(rng.normal(size=x.shape)) for x in maps]
        given, start, reference = jax.tree.map(jnp.asarray, (seen, astray(true), true))

        @jax.jit
        @jax.value_and_grad
        def cost(maps):
            walk = functools.partial(relocalize, variant="soft", temperature=0.5)
            ends = jax.vmap(walk, (0, None, None))(maps, row, col)
            offset = ends - (8 * jnp.stack([col, row], axis=-1)).astype(ends.dtype) - 3.5
            found = adjust(start, given._replace(xy=given.xy + offset))
            return pose_loss(found.cameras, reference)

        ahead, here, behind = jax.device_get(
            [
                cost([x + by * w for x, w in zip(maps, way, strict=True)])
                for by in (step, 0.0, -step)
            ]
        )
    slope = sum(np.sum(g * np.asarray(w)) for g, w in zip(here[1], way, strict=True))
    assert abs(slope) > 1e-6
    difference = (ahead[0] - behind[0]) / (2 * step)
    np.testing.assert_allclose(slope, difference, **tolerances.EXACT_GRADIENT)


@pytest.mark.parametrize("x64", [False, True])
def test_exact_observations_give_the_exact_poses(x64):
    true, seen, _ = scene(6, noise=0.0)
    given = (astray(true), seen, true)
    with jax.enable_x64(x64):
        loss, found, _ = solved(*(given if x64 else single(given)))
        before = solved(*given, steps=0)[0] if x64 else 1.0
    assert found.converged and found.determined.all()
    # Keypoints at 600 pixels are rounded to 3e-5 pixels in float32, which is 1e-7 rad.
    assert np.sqrt(loss) < (1e-12 if x64 else 1e-5) < 1e-3 < np.sqrt(before)
    assert found.error < (1e-9 if x64 else 1e-3)


def test_points_at_infinity_are_determined():
    true, _, box = scene(7, noise=0.0)
    box[:4, 3] = 0
    with jax.enable_x64(True):
        loss, found, _ = solved(astray(true), observations_of(true, box), true)
    assert found.converged and found.determined.all()
    np.testing.assert_allclose(found.points[:4, 3], 0, atol=1e-9)
    assert np.sqrt(loss) < 1e-9


def test_padding_changes_nothing():
    true, seen, _ = scene(8, noise=1.0)
    rng = rng_of(8)
    rows = Observations(rng.uniform(0, 600, (5, 37, 2)), np.zeros((5, 37)))
    rows.xy[:3, :30], rows.weight[:3, :30] = seen
    rows.weight[1, 36] = 1  # a point that one camera sees does not count either
    more = cameras_of(turns(rng, 2, 0.5), rng.normal(size=(2, 3)))
    start = astray(true)
    padded = Cameras(*(np.concatenate(both) for both in zip(start, more, strict=True)))
    with jax.enable_x64(True):
        _, ours, slope = solved(start, seen, true)
        _, wide, slopes = solved(padded, rows, true)
    first = Cameras(*(x[:3] for x in wide.cameras))
    for x, y in zip((*ours.cameras, ours.error), (*first, wide.error), strict=True):
        np.testing.assert_allclose(y, x, **tolerances.UNIT)
    assert ours.converged and wide.converged
    np.testing.assert_array_equal(wide.determined, np.arange(37) < 30)
    np.testing.assert_allclose(slopes[1].xy[:3, :30], slope[1].xy, rtol=1e-4, atol=1e-12)
    assert slope[1].xy.any() and not slopes[1].xy[3:].any() and not slopes[1].xy[:, 30:].any()


def degenerate(kind: str) -> tuple[Cameras, Observations]:
    """Three cameras; the third sees nothing."""
    true, seen, box = scene(10, noise=0.0)
    seen.weight[2] = 0
    if kind == "one place":
        return true._replace(translations=0 * true.translations), seen
    if kind == "rotation only":
        image = observations_of(true._replace(translations=0 * true.translations), box)
        return true, seen._replace(xy=image.xy)
    if kind == "one image twice":
        return true, seen._replace(xy=np.stack([seen.xy[0]] * 3))
    if kind == "a line":
        image = observations_of(true, box * [1, 0, 0, 1] + [0, 0, 6, 0])
        return true, seen._replace(xy=image.xy)
    blind = {"four points": np.s_[:, 4:], "no weights": np.s_[:], "a blind camera": np.s_[1]}
    seen.weight[blind[kind]] = 0
    return true, seen


@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize(
    "kind",
    [
        "four points",
        "one place",
        "one image twice",
        "rotation only",
        "a line",
        "no weights",
        "a blind camera",
    ],
)
def test_a_degenerate_scene_does_not_converge_and_its_gradient_is_zero(kind, x64):
    given = *degenerate(kind), scene(11, noise=0.0)[0]
    with jax.enable_x64(x64):
        _, found, slopes = solved(*(given if x64 else single(given)), scale=5.0)
    assert not found.converged and not found.determined.any()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    assert not any(np.any(x) for x in jax.tree.leaves(slopes))


def test_too_few_steps_do_not_converge():
    true, seen, _ = scene(12, noise=1.0)
    for start in (astray(true), true):  # far away, and so near that one step could be solved
        given = single((start, seen, true))
        assert not solved(*given, steps=0)[1].converged
        assert solved(*given)[1].converged


def test_the_first_camera_is_the_frame_and_the_second_the_scale():
    true, seen, _ = scene(13, noise=1.0)
    start = astray(true)
    turn, shift = turns(rng_of(14), 1, 1.0)[0], np.asarray([3.0, -2.0, 5.0])
    rotations = start.rotations @ turn
    translations = 7 * (start.translations + np.einsum("cij,j->ci", start.rotations, shift))
    elsewhere = start._replace(rotations=rotations, translations=translations)
    with jax.enable_x64(True):
        found, same = (solved(x, seen, true)[1].cameras for x in (start, elsewhere))
    for x, y in zip(found, same, strict=True):
        np.testing.assert_allclose(x, y, **tolerances.UNIT)
    np.testing.assert_array_equal(found.rotations[0], np.eye(3))
    np.testing.assert_array_equal(found.translations[0], 0)
    np.testing.assert_allclose(np.linalg.norm(found.translations[1]), 1, rtol=1e-12)
    for rotation in found.rotations:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_false_matches_lose_their_influence():
    true, seen, _ = scene(15, noise=0.0)
    seen.xy[1, :4] += [[60.0, -80.0]]
    with jax.enable_x64(True):
        plain, robust = (solved(astray(true), seen, true, scale=scale) for scale in (np.inf, 2.0))
    assert plain[1].converged and robust[1].converged
    assert np.sqrt(robust[0]) < 1e-3 < np.sqrt(plain[0])


def test_scenes_of_a_batch_are_adjusted_as_they_are_alone():
    scenes = [scene(seed, noise=1.0) for seed in (16, 17)]
    given = [single((astray(true), seen, true)) for true, seen, _ in scenes]
    batch = jax.tree.map(lambda *x: np.stack(x), *(x[:2] for x in given))
    together = jax.device_get(jax.jit(jax.vmap(adjust))(*batch))
    for k, one in enumerate(given):
        alone = solved(*one)[1]
        for x, y in zip(alone.cameras, together.cameras, strict=True):
            np.testing.assert_allclose(y[k], x, rtol=1e-4, atol=1e-4)
        assert together.converged[k] and alone.converged


def test_the_loss_of_poses_is_the_sum_of_two_squared_chords():
    true = cameras_of([np.eye(3)] * 3, [[0, 0, 0], [1, 0, 0], [0, 2, 0]])
    turned = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    rotations, translations = true.rotations.copy(), true.translations.copy()
    rotations[1] = turned
    translations[2] = 5 * Rotation.from_rotvec([0.4, 0, 0]).apply(translations[2])
    with jax.enable_x64(True):
        other = Cameras(rotations, translations, true.intrinsics)
        expected = ((2 * np.sin(0.15)) ** 2 + (2 * np.sin(0.2)) ** 2) / 2
        loss = compiled(jax.value_and_grad(pose_loss))
        np.testing.assert_allclose(loss(other, true)[0], expected, rtol=1e-12)
        np.testing.assert_array_equal(loss(true, true)[1].rotations, 0)


def test_one_camera_is_refused():
    true, seen, _ = scene(18, noise=0.0)
    with pytest.raises(ValueError, match="two cameras or more, but was given 1"):
        adjust(*single((Cameras(*(x[:1] for x in true)), Observations(*(x[:1] for x in seen)))))
