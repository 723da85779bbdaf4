"""Laws of the descriptors of whole images."""

import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import tolerances

from jaxsfm.core.pooling import NetVLADHead, gem, netvlad, vlad
from jaxsfm.core.vocabulary import Vocabulary

N, C, D, K = 30, 12, 6, 5


def units(rng, n: int = N, c: int = C) -> np.ndarray:
    x = np.maximum(rng.normal(size=(n, c)), 0).astype(np.float32) + np.float32(0.01)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def given() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    f32 = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    return {
        "x": units(rng),
        "mean": f32(C) / 10,
        "whitening": f32(C, D),
        "centres": f32(K, D) / 2,
        "assignment": 5 * f32(C, K),
        "net_centres": f32(C, K) / 3,
        "net_whitening": f32(C * K, 7),
        "net_bias": f32(7) / 10,
    }


def ours(given, kind: str, x: np.ndarray) -> np.ndarray:
    make = {name: jnp.asarray(value) for name, value in given.items()}
    if kind == "gem":
        return np.asarray(gem(jnp.asarray(x), power=3.0))
    if kind == "vlad":
        words = Vocabulary(make["mean"], make["whitening"], make["centres"])
        return np.asarray(vlad(jnp.asarray(x), words))
    head = NetVLADHead(
        make["assignment"], make["net_centres"], make["net_whitening"], make["net_bias"]
    )
    return np.asarray(netvlad(jnp.asarray(x), head))


def expected(given, kind: str) -> np.ndarray:
    g = given
    if kind == "gem":
        return oracles.gem(g["x"], 3.0)
    if kind == "vlad":
        return oracles.vlad(g["x"], g["mean"], g["whitening"], g["centres"])
    return oracles.netvlad(
        g["x"], g["assignment"], g["net_centres"], g["net_whitening"], g["net_bias"]
    )


KINDS = pytest.mark.parametrize("kind", ["gem", "vlad", "netvlad"])


@KINDS
def test_a_descriptor_equals_an_obvious_one(given, kind):
    found = ours(given, kind, given["x"])
    np.testing.assert_allclose(found, expected(given, kind), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found), 1, **tolerances.UNIT)


@KINDS
def test_padding_and_the_order_of_cells_do_not_matter(given, kind):
    rng = np.random.default_rng(1)
    mixed = np.zeros((N + 11, C), np.float32)
    mixed[rng.permutation(N + 11)[:N]] = given["x"]
    plain, other = ours(given, kind, given["x"]), ours(given, kind, mixed)
    np.testing.assert_allclose(other, plain, rtol=1e-5, atol=2e-6)


@KINDS
def test_an_image_without_descriptors_has_a_finite_one(given, kind):
    assert np.isfinite(ours(given, kind, np.zeros((4, C), np.float32))).all()
