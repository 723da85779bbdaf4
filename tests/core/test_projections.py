"""Laws of camera models."""

import jax
import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
from strategies import rng_of

from jaxsfm.core.cameras import (
    MODELS,
    WIDTH,
    directions,
    intrinsics_of,
    numbers_of,
    projected,
    slopes,
)

BENT = {"f": 400.0, "fx": 400.0, "fy": 380.0, "cx": 320.0, "cy": 240.0, "p1": 0.002, "p2": -0.003}
BENT |= {"k1": -0.05, "k2": 0.02, "k3": -0.01, "k4": 0.003}
"""A value of every parameter of a model."""


def params_of(model: str) -> list[float]:
    return [BENT[name] for name in MODELS[model].split()]


@jax.jit
def _all(params, model, rays):
    numbers, fisheye = (x[0] for x in numbers_of(params, model))
    wide = numbers[:, None] + 0 * rays[:1], fisheye + 0 * rays[0]
    derivative = jax.jacfwd(lambda *x: projected(x[0], fisheye, x[1]), (0, 1))
    xy = projected(*wide, rays)
    forward = jax.vmap(derivative, (None, 1))(numbers, rays)
    ways = jnp.eye(10)[..., None] + 0 * wide[0]
    return xy, slopes(*wide, rays, ways), forward, directions(*wide, xy)


def projections(model: str, rays: np.ndarray):
    """Places, derivatives by both ways, and the rays' coordinates again."""
    with jax.enable_x64(True):
        params, number = intrinsics_of([model], [params_of(model)])
        return jax.device_get(_all(params, number, rays.T))


def rays_of(model: str) -> np.ndarray:
    rays = rng_of(0).normal(size=(20, 3)) * [0.6, 0.6, 0.1] + [0, 0, 2]
    rays[0], rays[1] = [0, 0, 2], [1e-6, -1e-6, 3]
    if model.endswith("FISHEYE"):
        rays[2] = [1, 0.5, 0.02]  # at nearly 90 degrees from the axis
    return rays


@pytest.mark.parametrize("model", MODELS)
def test_a_projection_is_that_of_colmap(model):
    camera = pycolmap.Camera(model=model, width=640, height=480, params=params_of(model))
    rays = rays_of(model)
    found = projections(model, rays)[0].T
    np.testing.assert_allclose(found, camera.img_from_cam(rays), rtol=1e-13)


@pytest.mark.parametrize("model", MODELS)
def test_slopes_are_those_of_forward_mode(model):
    _, found, forward, _ = projections(model, rays_of(model))
    for ours, theirs in zip((found[:10], found[10:]), forward, strict=True):
        np.testing.assert_allclose(ours.T, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_directions_are_those_that_are_projected(model):
    rays = rays_of(model)
    ahead = rays[:, 2] > 0
    found = projections(model, rays)[3].T
    np.testing.assert_allclose(found[ahead], (rays[:, :2] / rays[:, 2:])[ahead], atol=1e-12)


def test_models_are_colmaps_own_with_their_parameters():
    for model, names in MODELS.items():
        info = pycolmap.Camera.create_from_model_name(0, model, 1.0, 2, 2).params_info
        assert info.split(", ") in (names.split(), names.replace("k1", "k").split())


def test_parameters_are_filled_with_zeros_and_counted():
    params, model = intrinsics_of(["PINHOLE"], [[1.0, 2.0, 3.0, 4.0]])
    np.testing.assert_array_equal(params, [[1, 2, 3, 4, 0, 0, 0, 0]])
    assert list(MODELS)[model[0]] == "PINHOLE" and params.shape == (1, WIDTH)
    with pytest.raises(ValueError, match="PINHOLE has 4 parameters, but was given 3"):
        intrinsics_of(["PINHOLE"], [[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match="not 'FOV'"):
        intrinsics_of(["FOV"], [[1.0, 2.0, 3.0]])
