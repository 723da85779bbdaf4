"""Laws of the differentiable path from images to an epipolar loss."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances
from compiled import compiled
from hypothesis import given, settings
from strategies import rng_of, seeds

from jaxsfm.core import soft_matching as core
from jaxsfm.core.matching import mutual_nn
from jaxsfm.core.scores import init_scores
from jaxsfm.core.soft_matching import pair_loss
from jaxsfm.core.vgg import init_shapes

soft_mutual, match = compiled(core.soft_mutual), compiled(mutual_nn)
fundamental_matrix, epipolar_loss = compiled(core.fundamental_matrix), compiled(core.epipolar_loss)
CAMERA = np.float32([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]])


def descriptors(seed: int, n: int) -> np.ndarray:
    x = np.float32(rng_of(seed).normal(size=(n, 8)))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_cold_weights_are_the_mutual_nearest_neighbours(seed):
    a, b = descriptors(seed, 20), descriptors(seed + 1, 30)
    b[3] = 0
    cold = soft_mutual(a, b, temperature=1e-5)
    nearest = a @ b.T
    nearest[:, 3] = -np.inf
    best0, best1 = nearest.argmax(1), nearest.argmax(0)
    expected = np.zeros_like(cold)
    for i, j in enumerate(best0):
        expected[i, j] = best1[j] == i
    top = np.sort(nearest, axis=1)[:, -2:]
    clear = top[:, 1] - top[:, 0] > 1e-3
    np.testing.assert_allclose(cold[clear] > 0.5, expected[clear] > 0.5)
    assert cold.min() >= 0 and cold.max() <= 1 and not cold[:, 3].any()


def test_cold_weights_find_what_the_pipeline_finds():
    a, b = descriptors(1, 16), descriptors(2, 16)
    partner = match(a, b)
    cold = soft_mutual(a, b, temperature=1e-5) > 0.5
    for i in range(16):
        assert cold[i].any() == (partner[i] >= 0)
        if partner[i] >= 0:
            assert cold[i, partner[i]]


def test_a_cell_of_the_first_image_is_observed_at_its_best_partner_in_each_other_image():
    rng = rng_of(3)
    places = [rng.uniform(0, 64, (n, 2)).astype(np.float32) for n in (6, 5, 7)]
    weights = [rng.uniform(size=(6, n)).astype(np.float32) for n in (5, 7)]
    seen = compiled(core.observed)(places, weights)
    xy, weight = seen.xy.reshape(3, 6, 2), seen.weight.reshape(3, 6)
    np.testing.assert_array_equal(xy[0], places[0])
    for i in range(6):
        best = [int(np.argmax(w[i])) for w in weights]
        for k, (j, w) in enumerate(zip(best, weights, strict=True), start=1):
            np.testing.assert_array_equal(xy[k, i], places[k][j])
            assert weight[k, i] == w[i, j]
        assert weight[0, i] == max(w[i, j] for w, j in zip(weights, best, strict=True))


def test_nothing_to_match_costs_nothing_and_has_finite_gradients():
    def cost(a, b):
        weights = core.soft_mutual(a, b, temperature=0.1)
        xy = jnp.ones((4, 2), jnp.float32)
        return core.epipolar_loss(weights, xy, xy, jnp.eye(3, dtype=jnp.float32))

    zeros = np.zeros((4, 8), np.float32)
    loss, gradient = compiled(jax.value_and_grad(cost))(zeros, zeros)
    assert loss == 0
    assert np.isfinite(gradient).all()


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_the_true_pose_has_no_epipolar_error(seed):
    rng = rng_of(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    translation = rng.normal(size=3)
    translation *= 1 + 0.5 / np.linalg.norm(translation)  # parallax enough to tell poses apart
    points = rng.normal(size=(30, 3)) + [0, 0, 6]
    moved = points @ rotation.T + translation

    def project(x):
        y = x @ CAMERA.astype(np.float64).T
        return np.float32(y[:, :2] / y[:, 2:])

    if np.abs(moved[:, 2]).min() < 0.3:
        return
    pose = [np.float32(x) for x in (rotation, translation)]
    f = fundamental_matrix(CAMERA, CAMERA, *pose)
    f = f / np.linalg.norm(f)
    same = np.eye(30, dtype=np.float32)
    found = epipolar_loss(same, project(points), project(moved), f)
    assert float(found) < 1e-3
    across = np.cross(translation, np.roll(translation, 1) + [0, 0, 1])  # at right angles
    across *= np.linalg.norm(translation) / np.linalg.norm(across)
    wrong = fundamental_matrix(CAMERA, CAMERA, pose[0], np.float32(across))
    assert float(epipolar_loss(same, project(points), project(moved), wrong)) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("part", ["scores", "conv1_1", "conv2_2", "conv3_3", "pose"])
def test_gradients_from_the_loss_to_the_parameters_are_those_of_central_differences(part):
    """Two images of 32 x 32 through the network, soft matches and soft keypoints, in float64."""
    shapes = init_shapes()
    with jax.enable_x64(True):
        rng = rng_of(7)
        draw = lambda x: jnp.asarray(rng.normal(size=x.shape) / np.sqrt(x.size / x.shape[-1]))  # noqa: E731
        params = jax.tree.map(draw, shapes)
        scores = jax.tree.map(
            lambda x: jnp.asarray(x, jnp.float64) + 0.3 * jnp.asarray(rng.normal(size=x.shape)),
            init_scores(jax.random.key(0), hidden=3),
        )
        images = [jnp.asarray(rng.normal(size=(32, 32, 3))) for _ in range(2)]
        sizes = [jnp.asarray([32, 32], jnp.int32)] * 2
        translation = jnp.asarray([1.0, 0.2, 0.1])
        camera = jnp.asarray(CAMERA, jnp.float64)

        def cost(params, scores, translation):
            f = core.fundamental_matrix(camera, camera, jnp.eye(3), translation)
            return pair_loss(params, scores, images, sizes, f / jnp.linalg.norm(f))

        arguments = [params, scores, translation]
        index = {"scores": 1, "pose": 2}.get(part, 0)
        way = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), arguments[index])
        if index == 0:
            keep = {k: float(part == k) for k in way["params"]}
            way = {
                "params": {
                    k: jax.tree.map(lambda x, k=k: x * keep[k], v) for k, v in way["params"].items()
                }
            }
        run = jax.jit(cost)

        def moved(step):
            there = list(arguments)
            there[index] = jax.tree.map(lambda x, w: x + step * w, arguments[index], way)
            return float(run(*there))

        gradient = jax.jit(jax.grad(cost, argnums=index))(*arguments)
        assert all(bool(jnp.isfinite(g).all()) for g in jax.tree.leaves(gradient))
        slope = sum(
            float(jnp.sum(g * w))
            for g, w in zip(jax.tree.leaves(gradient), jax.tree.leaves(way), strict=True)
        )
        step = 1e-8  # larger ones cross kinks
        difference = (moved(step) - moved(-step)) / (2 * step)
        assert abs(difference) > 1e-7
        np.testing.assert_allclose(slope, difference, **tolerances.EXACT_GRADIENT)
