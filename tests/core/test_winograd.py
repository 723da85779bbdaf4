"""Winograd's convolution is the convolution."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import tolerances
from jax import lax
from strategies import rng_of

from jaxsfm.core.winograd import conv3x3


def plain(x, kernel):
    """By XLA."""
    return lax.conv_general_dilated(
        x[None],
        kernel,
        (1, 1),
        "SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=lax.Precision.HIGHEST,
    )[0]


@pytest.mark.parametrize("tiles", [1, 7, 1000])
@pytest.mark.parametrize(
    "shape", [(1, 1, 3, 2), (2, 2, 1, 1), (1, 9, 4, 3), (8, 1, 2, 5), (7, 10, 4, 4), (13, 5, 5, 6)]
)
def test_equals_the_plain_sum_for_all_sizes_and_strips(shape, tiles):
    h, w, c, o = shape
    rng = rng_of(h + w)
    x = jnp.asarray(rng.normal(size=(h, w, c)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(3, 3, c, o)), jnp.float32)
    ours, expected = conv3x3(x, kernel, tiles=tiles), plain(x, kernel)
    assert ours.shape == expected.shape
    np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-5)


def test_rounding_is_that_of_the_plain_sum_on_many_channels():
    """The usual points 0, 1, -1, 2 and -2 would give 4.5e-6, and 1/2 and 2 more than 2e-6."""
    rng = rng_of(0)
    x = jnp.asarray(np.maximum(rng.normal(size=(12, 14, 512)), 0), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(3, 3, 512, 8)) / 68, jnp.float32)
    exact = oracles.convolution(np.asarray(x), np.asarray(kernel), np.zeros(8))
    error = np.abs(np.asarray(conv3x3(x, kernel)) - exact).max() / np.abs(exact).max()
    assert error < 2e-6


def test_gradients_are_those_of_the_plain_sum():
    rng = rng_of(1)
    x = jnp.asarray(rng.normal(size=(6, 7, 3)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(3, 3, 3, 4)), jnp.float32)
    weight = jnp.asarray(rng.normal(size=(6, 7, 4)), jnp.float32)
    ours, expected = (
        jax.grad(lambda x, k, f=f: jnp.sum(weight * f(x, k)), argnums=(0, 1))(x, kernel)
        for f in (conv3x3, plain)
    )
    for a, b in zip(ours, expected, strict=True):
        np.testing.assert_allclose(a, b, **tolerances.FEATURES)
