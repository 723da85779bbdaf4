"""Laws of bundle adjustment and of its gradient.

Most tests share one program: three photos, thirty points, and two cameras of any models.
"""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pycolmap
import pytest
import tolerances
from scipy.spatial.transform import Rotation
from strategies import rng_of
from test_projections import params_of

from jaxsfm.core import bundle_layout
from jaxsfm.core.bundle import (
    adjust,
    frame_held,
    pose_loss,
    relative_to_first,
    triangulated,
)
from jaxsfm.core.bundle_layout import Free, Layout, layout_of
from jaxsfm.core.bundle_problem import Observations, Poses, Scene
from jaxsfm.core.cameras import MODELS, intrinsics_of
from jaxsfm.core.relocalize import relocalize


@functools.partial(jax.jit, static_argnames="loss")
def _solved(start, seen, layout, ways, scale, steps, *, loss):
    """A loss of poses, points and parameters, the adjustment, and the gradient of the loss."""

    def cost(start, seen, scale):
        found = adjust(start, seen, layout, loss=loss, scale=scale, steps=steps)
        (rotations, translations), points, params = found.scene
        parts = rotations, translations, points, params
        return sum(jnp.sum(x * way) for x, way in zip(parts, ways, strict=True)), found

    return jax.value_and_grad(cost, (0, 1, 2), has_aux=True)(start, seen, scale)


def solved(start, seen, layout, *, scale=np.inf, steps=100, loss="cauchy"):
    rng, dtype = rng_of(99), start.params.dtype
    ways = [rng.normal(size=x.shape).astype(dtype) for x in (*start.poses, *start[1:])]
    ways[-1][:, :4] *= 1e-3  # focal lengths count as their distortion does
    scale = np.asarray(scale, dtype)
    with jax.enable_x64(dtype == np.float64):
        return jax.device_get(_solved(start, seen, layout, ways, scale, np.int32(steps), loss=loss))


def turns(rng, count: int, angle: float) -> np.ndarray:
    return Rotation.from_rotvec(angle * rng.normal(size=(count, 3))).as_matrix()


def poses_of(rotations, centres) -> Poses:
    return Poses(rotations, -np.einsum("cij,cj->ci", rotations, np.asarray(centres, float)))


def photographed(poses: Poses, points: np.ndarray, models: list[str]) -> np.ndarray:
    """Exact keypoints (c p 2) of homogeneous points, by COLMAP."""
    rays = np.einsum("cij,pj->cpi", poses.rotations, points[:, :3])
    rays += points[:, 3:] * poses.translations[:, None]
    cameras = [pycolmap.Camera(model=m, width=9, height=9, params=params_of(m)) for m in models]
    return np.stack([c.img_from_cam(x) for c, x in zip(cameras, rays, strict=True)])


class Made(types.SimpleNamespace):
    """A scene: the truth, keypoints, and what is given to the adjustment."""

    poses: Poses
    points: np.ndarray
    xy: np.ndarray
    weight: np.ndarray
    layout: Layout

    @property
    def start(self) -> Scene:
        """Poses a few degrees and a twentieth of the baseline off, and triangulated points."""
        rng, c = rng_of(9), len(self.poses.rotations)
        off = 0.05 if c <= 10 else 0.001
        rotations = np.einsum("cij,cjk->cik", turns(rng, c, off / 2), self.poses.rotations)
        translations = self.poses.translations + off * rng.normal(size=(c, 3))
        free = self.layout.free
        still = ~free.poses.any(1)
        rotations[still], translations[still] = (x[still] for x in self.poses)
        points = self.points + off * free.points[:, None] * rng.normal(size=self.points.shape)
        return Scene(Poses(rotations, translations), points, self.params)

    @property
    def given(self) -> tuple:
        seen = Observations(self.xy.reshape(-1, 2), self.weight.ravel())
        return self.start, seen, self.layout


def scene(
    seed: int,
    *,
    model="PINHOLE",
    noise=1.0,
    photos=3,
    count=30,
    known=False,
    dense: bool | None = True,
) -> Made:
    """Photos in an arbitrary frame, a box of points before them, and noisy keypoints of it. The
    second photo has another camera.

    Args:
      known: hold the cameras and the frame. If not, ten points and one pose are held.
    """
    rng = rng_of(seed)
    places = np.arange(photos)[:, None] * [1.0, 0.2, 0.1] + 0.1 * rng.normal(size=(photos, 3))
    poses = poses_of(turns(rng, photos, 0.1), places)
    points = np.column_stack([rng.uniform([-2, -2, 4], [4, 2, 9], (count, 3)), np.ones(count)])
    if photos > 10:  # the box is long
        points[:, :3] += np.linspace(0, photos, count)[:, None] * [1.0, 0.2, 0.1]
    models = [model, "PINHOLE" if known else "OPENCV"]
    camera = np.minimum(np.arange(photos), 1) * (np.arange(photos) < 2)
    exact = photographed(poses, points, [models[k] for k in camera])
    params, numbers = intrinsics_of(
        [*models, "OPENCV"], [params_of(m) for m in (*models, "OPENCV")]
    )
    own = np.asarray([np.arange(8) < len(MODELS[m].split()) for m in models])
    free = Free(
        np.ones((photos, 6), bool),
        np.arange(count) >= (0 if known else 10),
        np.concatenate([own & (not known), np.ones((1, 8), bool)]),  # no photo has the last camera
    )
    if known:
        with jax.enable_x64(True):
            free = free._replace(poses=np.asarray(frame_held(jax.tree.map(jnp.asarray, poses))))
    else:
        free.poses[-1] = False
    photo, point = np.mgrid[:photos, :count].reshape(2, -1)
    xy = exact + noise * rng.normal(size=exact.shape)
    weight = rng.uniform(0.2, 2.0, exact.shape[:2])
    weight[rng.integers(0, photos, 9), np.arange(11, 20)] = 0
    if photos > 10:
        near = np.abs(point / count * photos - photo) < 5
        photo, point, xy, weight = (
            photo[near],
            point[near],
            xy.reshape(-1, 2)[near],
            weight.ravel()[near],
        )
    layout = layout_of(photo, point, free, camera=camera, model=numbers, dense=dense)
    return Made(poses=poses, points=points, xy=xy, weight=weight, layout=layout, params=params)


def single(tree):
    return jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, tree)


def check_gradient(made: Made, *, scale: float, loss="cauchy", shrink=1.0):
    """The gradient along a random way of each part, beside central differences. `shrink` makes
    their steps smaller."""
    start, seen, layout = made.given
    rng, free = rng_of(3), layout.free
    still = ~free.poses.any(1)
    held = Scene(
        Poses(
            still[:, None, None] * rng.normal(size=start.poses.rotations.shape),
            still[:, None] * rng.normal(size=start.poses.translations.shape),
        ),
        ~free.points[:, None] * rng.normal(size=start.points.shape) * [1, 1, 1, 0],
        ~free.params * (start.params != 0) * rng.normal(size=start.params.shape),
    )
    xy, weight = rng.normal(size=seen.xy.shape), rng.normal(size=seen.weight.shape)
    ways = {
        "held": (0, held, 1e-5),
        "xy": (1, Observations(xy, 0 * weight), 1e-3),
        "weight": (1, Observations(0 * xy, weight * (seen.weight > 0)), 1e-3),
        "scale": (2, np.float64(1), 1e-2),
    }
    (_, found), slopes = solved(start, seen, layout, scale=scale, loss=loss)
    assert found.converged and found.cost > 10, (found.steps, found.cost)
    for part, (k, way, step) in ways.items():
        step, values = shrink * step, {}
        for by in (-2, -1, 1, 2):
            data = [start, seen, np.float64(scale)]
            data[k] = jax.tree.map(lambda x, d, by=by * step: x + by * d, data[k], way)
            values[by] = solved(data[0], data[1], layout, scale=data[2], loss=loss)[0][0]
        near, far = (values[n] - values[-n] for n in (1, 2))
        difference = (8 * near - far) / (12 * step)  # its error has the fourth power of the step
        terms = jax.tree.map(np.multiply, slopes[k], way)
        terms = np.concatenate([np.ravel(x) for x in jax.tree.leaves(terms)])
        size = np.linalg.norm(terms)  # of a sum of so many terms of either sign
        assert size > 1e-3
        np.testing.assert_allclose(terms.sum() / size, difference / size, atol=1e-5, err_msg=part)


@pytest.mark.parametrize("model", MODELS)
def test_the_gradient_is_that_of_central_differences(model):
    """Keypoints are a pixel off, so second derivatives of the residuals count. Some rows have no
    weight; ten points, one pose and zero or more parameters are held."""
    check_gradient(scene(1, model=model), scale=4.0)


@pytest.mark.slow
def test_the_gradient_of_hubers_loss_is_that_of_central_differences():
    """Its second derivative jumps, so no residual may pass the scale within a step."""
    check_gradient(scene(2, model="RADIAL"), scale=1.0, loss="huber", shrink=0.01)


@pytest.mark.slow
def test_the_gradient_of_a_row_of_photos_with_a_band_and_a_border_is_that_of_central_differences():
    made = scene(4, model="SIMPLE_RADIAL", photos=40, count=160, dense=None)
    assert made.layout.band is not None and not len(made.layout.own)
    check_gradient(made, scale=4.0)


@pytest.mark.slow
def test_cameras_may_be_a_border_or_part_of_each_photo(monkeypatch):
    made = scene(5, model="RADIAL", photos=40, count=160, dense=None)
    monkeypatch.setattr(bundle_layout, "MOST_SHARED", 0)
    other = scene(5, model="RADIAL", photos=40, count=160, dense=True)
    assert (len(made.layout.own), len(other.layout.own)) == (0, len(other.layout.columns))
    (one, found), slopes = solved(*made.given, scale=4.0)
    (two, there), others = solved(*other.given, scale=4.0)
    assert found.converged and there.converged
    np.testing.assert_allclose([one, found.cost], [two, there.cost], rtol=1e-9)
    for x, y in zip(jax.tree.leaves(slopes), jax.tree.leaves(others), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-7 * np.abs(y).max())


def test_the_gradient_of_ten_photos_without_a_matrix_is_that_of_central_differences(monkeypatch):
    """Rows come in four steps, and the reduced system is never formed."""
    monkeypatch.setattr(bundle_layout, "CHUNK", 80)
    made = scene(3, model="RADIAL", photos=10, dense=False)
    assert made.layout.pairs is None and made.layout.point.shape == (4, 80)
    check_gradient(made, scale=4.0)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_optimum_is_that_of_scipy(seed):
    made = scene(seed, known=True)
    (_, found), _ = solved(*made.given)
    assert found.converged and found.determined.all()
    fx, fy, cx, cy = made.params[0, :4]
    k = np.stack([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]] * 3)
    cameras = types.SimpleNamespace(
        rotations=made.poses.rotations, translations=made.poses.translations, intrinsics=k
    )
    expected = oracles.bundle_adjustment(cameras, made.points[:, :3], made.xy, made.weight)
    with jax.enable_x64(True):
        ours = relative_to_first(jax.tree.map(jnp.asarray, found.scene.poses))
    np.testing.assert_allclose(ours.rotations, expected[0], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(ours.translations, expected[1], rtol=1e-6, atol=1e-7)
    error = np.sqrt(2 * found.cost / made.weight.sum())
    np.testing.assert_allclose(error, expected[3], rtol=1e-9)
    assert 0.3 < error < 2


def test_exact_observations_give_the_exact_scene():
    made = scene(6, model="OPENCV", noise=0.0)
    (_, found), _ = solved(*made.given)
    assert found.converged and found.determined.all() and found.cost < 1e-15
    poses, points, params = found.scene
    for x, y in zip((*poses, params[:2]), (*made.poses, made.params[:2]), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(points / points[:, 3:], made.points, atol=1e-8)
    (_, before), _ = solved(*made.given, steps=0)
    assert before.cost > 100


@pytest.mark.slow
def test_in_float32_poses_are_right_to_the_rounding_of_keypoints():
    """Keypoints at 600 pixels are rounded to 3e-5 pixels, which is 1e-7 rad."""
    made = scene(6, known=True, noise=0.0)
    (_, found), slopes = solved(*single(made.given))
    assert found.converged and found.scene.points.dtype == np.float32
    reference = jax.tree.map(jnp.asarray, single(made.poses))
    assert np.sqrt(pose_loss(jax.tree.map(jnp.asarray, found.scene.poses), reference)) < 1e-5
    for kind in ("four points", "no weights", "a blind photo"):
        (_, found), slopes = solved(*single(degenerate(kind).given), scale=5.0)
        assert not found.converged, kind
        assert not any(np.any(x) for x in jax.tree.leaves(slopes[1]))


def test_points_at_infinity_are_determined():
    made = scene(7, known=True, noise=0.0)
    made.points[:4, 3] = 0
    made.xy[:] = photographed(made.poses, made.points, ["PINHOLE"] * 3)
    made.weight[:] = 1
    (_, found), _ = solved(*made.given)
    assert found.converged and found.determined.all() and found.cost < 1e-15
    np.testing.assert_allclose(found.scene.points[:4, 3], 0, atol=1e-9)


def test_rows_without_weight_change_nothing():
    made = scene(8, known=True)
    blind = made.weight == 0
    blind[:, 29] = [True, False, True]  # a point that one photo sees does not count either
    made.weight[[0, 2], 29] = 0
    results = []
    for seed in (1, 2):
        start, (xy, weight), layout = made.given
        xy = np.where(blind.ravel()[:, None], rng_of(seed).uniform(0, 600, xy.shape), xy)
        xy[59] += seed
        results.append(solved(start, Observations(xy, weight), layout, scale=4.0))
    jax.tree.map(
        np.testing.assert_array_equal,
        results[0][0][1]._replace(scene=None),
        results[1][0][1]._replace(scene=None),
    )
    jax.tree.map(np.testing.assert_array_equal, *(r[0][1].scene.poses for r in results))
    (_, found), (_, slopes, _) = results[0]
    assert found.converged
    np.testing.assert_array_equal(found.determined, np.arange(30) < 29)
    assert slopes.xy[~blind.ravel()][:59].any() and not slopes.xy[blind.ravel()].any()


def degenerate(kind: str) -> Made:
    """A scene whose third photo sees nothing."""
    made = scene(10, known=True, noise=0.0)
    made.weight[:] = 1
    made.weight[2] = 0
    still = made.poses._replace(translations=0 * made.poses.translations)
    if kind == "one image twice":
        made.xy[1] = made.xy[0]
    elif kind == "rotation only":
        made.xy[:] = photographed(still, made.points, ["PINHOLE"] * 3)
    elif kind == "a line":
        made.points[:] = made.points * [1, 0, 0, 1] + [0, 0, 6, 0]
        made.xy[:] = photographed(made.poses, made.points, ["PINHOLE"] * 3)
    else:
        blind = {"four points": np.s_[:, 4:], "no weights": np.s_[:], "a blind photo": np.s_[1]}
        made.weight[blind[kind]] = 0
    return made


DEGENERATE = (
    "four points",
    "one image twice",
    "rotation only",
    "a line",
    "no weights",
    "a blind photo",
)


@pytest.mark.parametrize("kind", DEGENERATE)
def test_a_degenerate_scene_does_not_converge_and_its_gradient_is_zero(kind):
    (_, found), slopes = solved(*degenerate(kind).given, scale=5.0)
    assert not found.converged and not found.determined.any()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    assert not any(np.any(x) for x in jax.tree.leaves(slopes[1]))


def test_too_few_steps_do_not_converge():
    made = scene(12, known=True)
    assert not solved(*made.given, steps=0)[0][1].converged
    assert solved(*made.given)[0][1].converged


def test_without_a_frame_the_cost_is_least_but_there_is_no_gradient():
    made = scene(13, known=True)
    start, seen, layout = made.given
    loose = layout._replace(free=layout.free._replace(poses=np.ones((3, 6), bool)))
    (_, held), _ = solved(start, seen, layout)
    (_, found), slopes = solved(start, seen, loose)
    np.testing.assert_allclose(found.cost, held.cost, rtol=1e-9)
    assert held.converged and not found.converged
    assert not any(np.any(x) for x in jax.tree.leaves(slopes[1]))


def test_what_is_held_stays():
    made = scene(14, model="SIMPLE_RADIAL")
    start, seen, layout = made.given
    layout.free.params[0, 1:3] = False  # the principal point
    layout.free.poses[1, 4] = False
    (_, found), _ = solved(start, seen, layout)
    assert found.converged
    poses, points, params = found.scene
    np.testing.assert_array_equal(params[~layout.free.params], start.params[~layout.free.params])
    np.testing.assert_allclose(poses.rotations[2], start.poses.rotations[2], rtol=1e-14)
    still = ~layout.free.poses[:, 3:]
    np.testing.assert_allclose(
        poses.translations[still], start.poses.translations[still], rtol=1e-14
    )
    np.testing.assert_allclose((points / points[:, 3:])[:10], made.points[:10], rtol=1e-14)
    assert np.all(poses.translations[~still] != start.poses.translations[~still])


def test_false_matches_lose_their_influence():
    made = scene(15, known=True, noise=0.0)
    made.xy[1, :4] += [[60.0, -80.0]]
    off = [
        np.abs(solved(*made.given, scale=scale)[0][1].scene.poses.rotations - made.poses.rotations)
        for scale in (np.inf, 2.0)
    ]
    assert off[1].max() < 1e-3 < off[0].max()


def test_rows_of_other_photos_or_points_are_refused():
    _, _, layout = scene(16).given
    rows = layout.photo.ravel(), layout.point.ravel()
    for name, index, end in (("photo", 0, 2), ("point", 1, 29)):
        wrong = [
            np.where(np.arange(90) == 7, end + 1, x) if k == index else x
            for k, x in enumerate(rows)
        ]
        with pytest.raises(ValueError, match=f"{name} must be in 0 to {end}, but has {end + 1}"):
            layout_of(*wrong, layout.free, camera=layout.camera, model=layout.model)


def test_points_are_triangulated_where_their_rays_meet():
    made = scene(17, model="OPENCV_FISHEYE", noise=0.0)
    made.weight[:] = 1
    _, seen, layout = made.given
    with jax.enable_x64(True):
        found = jax.device_get(jax.jit(triangulated)(made.poses, made.params, seen, layout))
    np.testing.assert_allclose(found / found[:, 3:], made.points, rtol=1e-8)


@pytest.mark.slow
def test_scenes_of_a_batch_are_adjusted_as_they_are_alone():
    scenes = [scene(seed, known=True) for seed in (16, 17)]
    layout = scenes[0].layout
    given = [made.given[:2] for made in scenes]
    batch = jax.tree.map(lambda *x: np.stack(x), *given)
    with jax.enable_x64(True):
        together = jax.device_get(jax.jit(jax.vmap(lambda *x: adjust(*x, layout)))(*batch))
    for k, one in enumerate(given):
        (_, alone), _ = solved(*one, layout)
        for x, y in zip(alone.scene.poses, together.scene.poses, strict=True):
            np.testing.assert_allclose(y[k], x, rtol=1e-9, atol=1e-9)
        assert together.converged[k] and alone.converged


@pytest.mark.slow
def test_memory_grows_with_the_rows_and_not_with_photos_times_points():
    sizes = []
    for photos, count in ((40, 1000), (40, 2000), (80, 2000)):
        made = scene(18, photos=photos, count=count, known=True, dense=False)
        photo, point = (np.repeat(np.arange(n), m) for n, m in ((photos, 1), (count, 4)))
        photo = (point + np.tile(np.arange(4), count)) % photos
        layout = layout_of(
            photo,
            point,
            made.layout.free,
            camera=made.layout.camera,
            model=made.layout.model,
            dense=False,
        )
        seen = Observations(np.zeros((4 * count, 2)), np.ones(4 * count))
        with jax.enable_x64(True):
            program = jax.jit(jax.grad(lambda s, o, x: adjust(s, o, x).scene.points.sum(), 1))
            compiled = program.lower(made.start, seen, layout).compile()
        sizes.append(compiled.memory_analysis().temp_size_in_bytes)
    assert sizes[1] < 2.2 * sizes[0]  # twice the rows
    assert sizes[2] < 1.2 * sizes[1]  # the same rows in twice as many photos


@pytest.mark.slow
def test_the_gradient_of_a_pose_loss_reaches_the_scores_of_walks():
    made = scene(4, known=True, noise=0.0)
    start, (xy, weight), layout = made.given
    row, col = (x.ravel().astype(np.int32) for x in np.mgrid[:5, :6])
    step, rng = 1e-4, rng_of(5)
    with jax.enable_x64(True):
        maps = [rng.uniform(0.5, 1.5, (3, 5 << k, 6 << k)) for k in (1, 2, 3)]
        way = [rng.normal(size=x.shape) for x in maps]

        @jax.jit
        @jax.value_and_grad
        def cost(maps):
            walk = functools.partial(relocalize, variant="soft", temperature=0.5)
            ends = jax.vmap(walk, (0, None, None))(maps, *map(jnp.asarray, (row, col)))
            offset = ends - (8.0 * np.stack([col, row], axis=-1)) - 3.5
            seen = Observations(xy + offset.reshape(-1, 2), weight)
            return pose_loss(adjust(start, seen, layout).scene.poses, made.poses)

        ahead, here, behind = jax.device_get(
            [
                cost([x + by * w for x, w in zip(maps, way, strict=True)])
                for by in (step, 0.0, -step)
            ]
        )
    slope = sum(np.sum(g * w) for g, w in zip(here[1], way, strict=True))
    assert abs(slope) > 1e-6
    difference = (ahead[0] - behind[0]) / (2 * step)
    np.testing.assert_allclose(slope, difference, **tolerances.EXACT_GRADIENT)


def test_the_loss_of_poses_is_the_sum_of_two_squared_chords():
    true = poses_of(np.stack([np.eye(3)] * 3), [[0, 0, 0], [1, 0, 0], [0, 2, 0]])
    turned = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    rotations, translations = true.rotations.copy(), true.translations.copy()
    rotations[1] = turned
    translations[2] = 5 * Rotation.from_rotvec([0.4, 0, 0]).apply(translations[2])
    with jax.enable_x64(True):
        other, reference = (
            jax.tree.map(jnp.asarray, x) for x in (Poses(rotations, translations), true)
        )
        expected = ((2 * np.sin(0.15)) ** 2 + (2 * np.sin(0.2)) ** 2) / 2
        loss = jax.jit(jax.value_and_grad(pose_loss))
        np.testing.assert_allclose(loss(other, reference)[0], expected, rtol=1e-12)
        np.testing.assert_array_equal(loss(reference, reference)[1].rotations, 0)
