"""Laws of the descriptors of whole images, and of a collection's vocabulary."""

import functools

import numpy as np
import oracles
import pytest
import tolerances
from compiled import compiled

from jaxsfm.core import retrieval
from jaxsfm.core.retrieval import (
    NetVLADHead,
    Vocabulary,
    fit_vocabulary,
)

N, C, D, K = 30, 12, 6, 5
fit = compiled(functools.partial(fit_vocabulary, words=4, directions=3))
gem = compiled(retrieval.gem, "power")
vlad, netvlad = compiled(retrieval.vlad), compiled(retrieval.netvlad)
lloyd, whitened = compiled(retrieval.lloyd), compiled(retrieval.whitened)


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
    if kind == "gem":
        return gem(x, power=3.0)
    if kind == "vlad":
        words = Vocabulary(given["mean"], given["whitening"], given["centres"])
        return vlad(x, words)
    head = NetVLADHead(
        given["assignment"], given["net_centres"], given["net_whitening"], given["net_bias"]
    )
    return netvlad(x, head)


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


def sample(n: int = 128, c: int = 8) -> np.ndarray:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(n, c)) * np.linspace(0.2, 2, c) + 1
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def test_centres_equal_those_of_an_obvious_k_means():
    x = sample(60, 4)
    start = np.r_[x[:5], [[9.0, 9, 9, 9]]].astype(np.float32)  # the last one is nobody's
    found = lloyd(np.r_[x, np.zeros((7, 4), np.float32)], start)
    np.testing.assert_allclose(found, oracles.lloyd(x, start, 25), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found[5], start[5])


def test_directions_are_whitened_and_of_the_largest_variance(key):
    x = sample()
    words = fit(key, x)
    flat = (x - x.mean(0)) @ words.whitening
    np.testing.assert_allclose(flat.T @ flat / len(x), np.eye(3), atol=1e-3)
    largest = np.linalg.eigvalsh(np.cov(x.T, bias=True))[-3:]
    np.testing.assert_allclose(np.linalg.norm(words.whitening, axis=0), largest**-0.5, rtol=1e-3)


def test_zero_rows_of_a_sample_do_not_count(key):
    x = sample(100)
    padded = np.r_[x, np.zeros((28, 8), np.float32)]
    words = fit(key, padded)
    np.testing.assert_allclose(words.mean, x.mean(0), rtol=1e-5)
    alone = np.abs(fit(key, x).whitening)  # axes have no sign
    np.testing.assert_allclose(np.abs(words.whitening), alone, rtol=1e-3, atol=1e-4)
    assert np.all(np.linalg.norm(words.centres, axis=1) > 0.1)
    assert not np.any(whitened(padded, words)[100:])


def test_a_sample_that_lies_in_a_plane_or_in_a_point_gives_finite_words(key):
    flat = np.zeros((128, 8), np.float32)
    flat[:, :2] = sample(128, 2)
    for x in (flat, np.tile(flat[:1], (128, 1)), np.zeros((128, 8), np.float32)):
        words = fit(key, x)
        assert all(np.isfinite(part).all() for part in words)


@pytest.mark.parametrize("shape", [(3, 8), (50, 2)])
def test_too_small_a_sample_is_an_error(key, shape):
    with pytest.raises(ValueError, match=f"4 rows of 3 channels; got {shape[0]} of {shape[1]}"):
        fit(key, np.zeros(shape, np.float32))
