"""Laws of learned scores."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances
from compiled import compiled
from hypothesis import given, settings
from strategies import rng_of, seeds

from jaxsfm.core import scores as core
from jaxsfm.core.numerics import squared_norm
from jaxsfm.core.scores import PLACES, WALKED, Scores, heads_of
from jaxsfm.core.vgg import VGG16
from jaxsfm.io.weights import load_weights

init_scores = compiled(core.init_scores, "hidden")
apply = compiled(Scores(5).apply)


def random_maps(seed: int) -> tuple[np.ndarray, ...]:
    rng = rng_of(seed)
    shapes = zip((32, 16, 8), WALKED.values(), strict=True)
    return tuple(np.float32(rng.normal(size=(s, s + 8, c))) for s, c in shapes)


def random_scores(seed: int) -> dict:
    params = init_scores(jax.random.key(seed), hidden=5)
    rng = rng_of(seed)
    return jax.tree.map(lambda x: x + rng.normal(size=x.shape).astype(x.dtype) / 4, params)


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(seeds)
def test_untrained_scores_are_squared_norms_to_the_last_bit(seed):
    params = core.init_scores(jax.random.key(seed))
    maps = jax.tree.map(jnp.asarray, random_maps(seed))
    for ours, x in zip(Scores().apply(params, maps), maps, strict=True):
        np.testing.assert_array_equal(ours, squared_norm(x))


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_scores_are_what_the_formula_says(seed):
    """Cell by cell, in float64."""
    maps, params = random_maps(seed), random_scores(seed)
    found = apply(params, maps)
    rng = rng_of(seed)
    for name, x, ours in zip(WALKED, maps, found, strict=True):
        p = {k: np.asarray(v, np.float64) for k, v in params["params"][name].items()}
        for _ in range(20):
            r, c = rng.integers(0, x.shape[0]), rng.integers(0, x.shape[1])
            f = np.asarray(x[r, c], np.float64)
            hidden = np.maximum(p["kernel"].T @ (f / np.linalg.norm(f)) + p["bias"], 0)
            n = PLACES[name]
            expected = f @ f * np.exp(p["out"] @ hidden + p["place"][r % n, c % n])
            np.testing.assert_allclose(ours[r, c], expected, rtol=1e-4)


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_a_gain_of_the_maps_scales_all_scores_alike(seed):
    maps, params = random_maps(seed), random_scores(seed)
    plain = apply(params, maps)
    louder = apply(params, tuple(np.float32(3) * x for x in maps))
    for a, b in zip(plain, louder, strict=True):
        np.testing.assert_allclose(9 * a, b, rtol=1e-4)


def test_scores_of_zeros_are_zero_and_have_finite_gradients():
    maps = [np.zeros_like(x) for x in random_maps(0)]

    def total(params, maps):
        return sum(jnp.sum(s) for s in Scores(5).apply(params, maps))

    params = random_scores(0)
    at_zero, gradients = compiled(jax.value_and_grad(total, argnums=(0, 1)))(params, maps)
    assert at_zero == 0
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradients))


def test_scores_stay_finite_whatever_was_learned():
    params = jax.tree.map(lambda x: np.full_like(x, 1e4), random_scores(0))
    for sign in (1.0, -1.0):
        params["params"]["pool1"]["out"] = np.full((5,), sign * 1e4, np.float32)
        for found in apply(params, random_maps(1)):
            assert np.isfinite(found).all()


@pytest.mark.slow
def test_the_network_scores_strip_by_strip_as_on_whole_maps():
    weights, params = load_weights(), jax.tree.map(jnp.asarray, random_scores(3))
    rng = rng_of(0)
    size = np.asarray([[57, 71]], np.int32)
    image = np.zeros((1, 64, 80, 3), np.float32)
    image[:, :57, :71] = rng.normal(size=(1, 57, 71, 3))
    network = functools.partial(VGG16().apply, weights.params, jnp.asarray(image))
    levels = network(jnp.asarray(size), heads_of(params), method="levels")
    maps = network(jnp.asarray(size), method="walked")
    for ours, expected in zip(levels.scores, Scores(5).apply(params, maps), strict=True):
        scale = float(jnp.abs(expected).max())
        np.testing.assert_allclose(ours / scale, expected / scale, **tolerances.FEATURES)
    pyramid = network(jnp.asarray(size))
    for ours, expected in zip(maps, (pyramid.conv1_2, pyramid.pool1, pyramid.pool2), strict=True):
        np.testing.assert_allclose(ours, expected, **tolerances.FEATURES)


def test_without_parameters_the_rule_is_the_norm():
    x = random_maps(0)[0]
    assert heads_of(None) == (None, None, None)
    np.testing.assert_array_equal(core.score(jnp.asarray(x), None), squared_norm(jnp.asarray(x)))
