"""Winograd's convolution is the convolution."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import tolerances
from compiled import compiled
from jax import lax
from strategies import rng_of

from jaxsfm.core import winograd

conv3x3 = compiled(winograd.conv3x3, "tiles")


def _plain(x, kernel):
    """By XLA."""
    return lax.conv_general_dilated(
        x[None],
        kernel,
        (1, 1),
        "SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=lax.Precision.HIGHEST,
    )[0]


plain = compiled(_plain)


ROUNDINGS = 28
"""So many roundings lie one behind the other on the way of an input to an output, beside those of
the sum over channels: along each axis at most 4 in the transform of the inputs, 5 in that of the
kernel, and 5 in that of the outputs."""


def most_rounding(x: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """The largest error that rounding can make, whatever the order of the sums.

    n roundings change a sum of products by at most n units of rounding of the sum of their absolute
    values (Higham 2002, "Accuracy and Stability of Numerical Algorithms", section 3.1). So the
    bound is the algorithm itself on absolute values.
    """
    transforms = ((winograd._inputs, 6), (winograd._kernels, 3), (winograd._outputs, 6))
    inputs, kernels, outputs = (np.abs(np.stack(f([*jnp.eye(n)]))) for f, n in transforms)
    h, w, c = x.shape
    down, across = -(-h // 4), -(-w // 4)
    padded = np.pad(np.abs(x), ((1, 4 * down - h + 1), (1, 4 * across - w + 1), (0, 0)))
    g = np.einsum("ij,jkco,lk->ilco", kernels, np.abs(kernel), kernels)
    largest = np.zeros((4 * down, 4 * across, kernel.shape[3]))
    for i in range(0, 4 * down, 4):
        for j in range(0, 4 * across, 4):
            d = np.einsum("ij,jkc,lk->ilc", inputs, padded[i : i + 6, j : j + 6], inputs)
            products = np.einsum("ilc,ilco->ilo", d, g)
            largest[i : i + 4, j : j + 4] = np.einsum("ij,jko,lk->ilo", outputs, products, outputs)
    return (ROUNDINGS + c) * 2.0**-24 * largest[:h, :w]


@pytest.mark.parametrize("tiles", [1, 7, 1000])
@pytest.mark.parametrize(
    "shape", [(1, 1, 3, 2), (2, 2, 1, 1), (1, 9, 4, 3), (8, 1, 2, 5), (7, 10, 4, 4), (13, 5, 5, 6)]
)
def test_equals_the_plain_sum_for_all_sizes_and_strips_but_for_rounding(shape, tiles):
    h, w, c, o = shape
    rng = rng_of(h + w)
    x = np.float32(rng.normal(size=(h, w, c)))
    kernel = np.float32(rng.normal(size=(3, 3, c, o)))
    ours, exact = conv3x3(x, kernel, tiles=tiles), oracles.convolution(x, kernel, np.zeros(o))
    most = most_rounding(x, kernel)
    assert ours.shape == exact.shape and most.max() < 1e-2  # a wrong sum differs by about 1
    assert (np.abs(ours - exact) <= most).all()


def rounding(convolve) -> float:
    """The root of the mean squared error on many channels, relative to the result."""
    rng = rng_of(0)
    x = np.maximum(rng.normal(size=(24, 22, 512)), 0).astype(np.float32)
    kernel = (rng.normal(size=(3, 3, 512, 8)) / 68).astype(np.float32)
    exact = oracles.convolution(x, kernel, np.zeros(8))
    error = convolve(x, kernel) - exact
    return np.sqrt(np.mean(error**2) / np.mean(exact**2))


@pytest.mark.parametrize(("a", "b", "least"), [(1.0, 2.0, 1.6), (0.5, 2.0, 1.15), (0.5, 1.0, 1.6)])
def test_other_points_round_more(a, b, least, monkeypatch):
    """How much a sum rounds depends on the vector units of the machine: ratios hold on all."""
    ours = rounding(conv3x3)
    monkeypatch.setattr(winograd, "SUM", a**2 + b**2)
    monkeypatch.setattr(winograd, "PRODUCT", a**2 * b**2)
    monkeypatch.setattr(winograd, "A", a)
    monkeypatch.setattr(winograd, "B", b)
    # A function of its own: that of before is compiled with the points of before.
    assert rounding(compiled(lambda *given: winograd.conv3x3(*given))) > least * ours


def test_rounding_is_a_few_times_that_of_the_plain_sum_on_many_channels():
    """Measured: 3.5 times, on a machine with vector units of 256 bits."""
    assert rounding(conv3x3) < 5 * rounding(plain)


def test_gradients_are_those_of_the_plain_sum():
    rng = rng_of(1)
    x, kernel, weight = (
        np.float32(rng.normal(size=s)) for s in ((6, 7, 3), (3, 3, 3, 4), (6, 7, 4))
    )
    ours, expected = (
        compiled(jax.grad(lambda x, k, f=f: jnp.sum(weight * f(x, k)), argnums=(0, 1)))(x, kernel)
        for f in (winograd.conv3x3, _plain)
    )
    for a, b in zip(ours, expected, strict=True):
        np.testing.assert_allclose(a, b, **tolerances.FEATURES)
