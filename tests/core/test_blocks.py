"""Laws of a network block: the ways for CPUs and for accelerators give the same maps.

Which way is taken is decided when a program is compiled for a platform. Here both run on this one.
"""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import tolerances
from compiled import compiled
from strategies import rng_of

from jaxsfm.core import blocks
from jaxsfm.core.blocks import Layer
from jaxsfm.core.scores import Head

SIZES = np.int32([[40, 24], [27, 19]])
clear_padding = compiled(blocks.clear_padding)


@pytest.fixture
def way(monkeypatch):
    """Make the block take the way of a platform: `cpu` or `default`."""

    def take(name: str):
        def chosen(*args, cpu, default):
            return (cpu if name == "cpu" else default)(*args)

        monkeypatch.setattr(blocks, "platform_dependent", chosen)
        jax.clear_caches()

    yield take
    jax.clear_caches()


def layers(rng, *channels: int) -> list[Layer]:
    def layer(inputs, outputs):
        kernel = rng.normal(size=(3, 3, inputs, outputs)) / (3 * inputs**0.5)
        return Layer(np.float32(kernel), np.float32(rng.normal(size=outputs) / 10))

    return [layer(*each) for each in zip(channels, channels[1:], strict=False)]


def images(rng, channels: int):
    x = rng.normal(size=(2, 40, 24, channels)).astype(np.float32)
    return clear_padding(x, SIZES)


def head_of(rng, channels: int) -> Head:
    shapes = ((channels, 4), (4,), (4,), (8, 8))
    return Head(*(np.float32(rng.normal(size=s) / 4) for s in shapes))


def score_of(x: np.ndarray, head: Head | None) -> np.ndarray:
    square = (x.astype(np.float64) ** 2).sum(-1)
    if head is None:
        return square
    kernel, bias, out, place = (np.asarray(a, np.float64) for a in head)
    unit = x / np.maximum(np.sqrt(square), 1e-30)[..., None]
    hidden = np.maximum(unit @ kernel + bias, 0)
    row, col = np.mgrid[: x.shape[0], : x.shape[1]] % 8
    return square * np.exp(hidden @ out + place[row, col])


def assert_close(ours, expected):
    scale = np.abs(expected).max()
    np.testing.assert_allclose(ours / scale, expected / scale, **tolerances.FEATURES)


@pytest.mark.parametrize("name", ["cpu", "default"])
@pytest.mark.parametrize("learned", [False, True])
def test_a_block_is_its_convolutions_one_after_the_other(way, name, learned):
    """Each image on its own, rectified between its layers but not after the last."""
    rng = rng_of(0)
    first, second = stack = layers(rng, 3, 6, 5)
    x, head = images(rng, 3), head_of(rng, 5) if learned else None
    way(name)
    run = compiled(lambda *given, head: blocks.scores_and_pool(*given, large=True, head=head))
    scores, pooled = run(x, SIZES, stack, head=head)
    for i, (rows, cols) in enumerate(SIZES):
        one = oracles.convolution(x[i, :rows, :cols], *first)
        two = oracles.convolution(np.maximum(one, 0), *second)
        assert_close(scores[i, :rows, :cols], score_of(two, head))
        expected = oracles.max_pool(np.maximum(two, 0))
        assert_close(pooled[i, : rows // 2, : cols // 2], expected)
        assert not scores[i, rows:].any() and not scores[i, :, cols:].any()
        assert not pooled[i, rows // 2 :].any()
        assert not pooled[i, :, cols // 2 :].any()


def whole_numbers(rng, *channels: int):
    """Layers and images whose sums are exact in float32, in any order."""
    kernels = [
        rng.integers(-1, 2, (3, 3, *each)) for each in zip(channels, channels[1:], strict=False)
    ]
    stack = [Layer(np.float32(k), np.ones(k.shape[3], np.float32)) for k in kernels]
    x = np.float32(rng.integers(-2, 3, (2, 40, 24, channels[0])))
    return stack, clear_padding(x, SIZES)


@pytest.mark.optimized
@pytest.mark.parametrize("bfloat16", [False, True])
def test_whole_maps_and_strips_are_equal_bit_for_bit(way, monkeypatch, bfloat16):
    stack, x = whole_numbers(rng_of(1), 3, 6, 5)
    made = []
    for name, large in (("cpu", True), ("default", True), ("cpu", False)):
        way(name)
        if (name, large) != ("cpu", True):
            monkeypatch.setattr(blocks, "_strips", None)
        run = jax.jit(
            lambda *given, large: blocks.scores_and_pool(*given, large=large, bfloat16=bfloat16),
            static_argnames="large",
        )
        made.append(run(x, SIZES, stack, large=large))
    for scores, pooled in made[1:]:
        np.testing.assert_array_equal(scores, made[0][0])
        np.testing.assert_array_equal(pooled, made[0][1])


@pytest.mark.optimized
def test_products_of_bfloat16_are_the_cpus_bit_for_bit(way):
    """Where sums are exact in float32 in any order: small whole numbers, results past 8 bits."""
    rng = rng_of(2)
    x = jnp.asarray(rng.integers(-40, 40, (1, 9, 8, 4)), jnp.float32) / 7
    kernel = jnp.asarray(rng.integers(-3, 4, (3, 3, 4, 5)), jnp.float32)
    layer, made = Layer(kernel, jnp.full((5,), 0.1, jnp.float32)), []
    for name in ("cpu", "default"):
        way(name)
        made.append(np.asarray(blocks.conv(x, layer, bfloat16=True)))
    np.testing.assert_array_equal(*made)
    low = np.asarray(x[0].astype(jnp.bfloat16).astype(jnp.float32))
    exact = jnp.asarray(oracles.convolution(low, np.asarray(kernel), np.zeros(5)), jnp.float32)
    expected = np.asarray(exact.astype(jnp.bfloat16).astype(jnp.float32)) + np.float32(0.1)
    np.testing.assert_array_equal(made[0][0], expected)


@pytest.mark.parametrize("bfloat16", [False, True])
def test_deep_layers_are_the_plain_sum_on_either_platform(way, monkeypatch, bfloat16):
    """CPUs take Winograd's convolution there, and the library's nowhere else."""
    monkeypatch.setattr(blocks, "WINOGRAD_CHANNELS", 4)
    monkeypatch.setattr(blocks, "WINOGRAD_PRODUCTS", 1800)
    rng = rng_of(3)
    (layer,), used = layers(rng, 4, 5), []
    conv3x3 = blocks.conv3x3
    monkeypatch.setattr(blocks, "conv3x3", lambda *a: (used.append(1), conv3x3(*a))[1])
    for shape, deep in (((1, 10, 9, 4), True), ((1, 10, 8, 4), False)):
        x = np.float32(rng.normal(size=shape))
        operands = [x[0], layer.kernel]
        if bfloat16:
            operands = [a.astype(jnp.bfloat16).astype(np.float32) for a in operands]
        expected = oracles.convolution(*operands, layer.bias)
        for name in ("cpu", "default"):
            way(name)
            used.clear()
            conv = compiled(lambda *given: blocks.conv(*given, bfloat16=bfloat16))
            ours = conv(x, layer)[0]
            scale = np.abs(expected).max()
            # The result too is rounded to bfloat16's eight bits: a 256th, and half of that.
            np.testing.assert_allclose(ours, expected, atol=scale / (400 if bfloat16 else 1e5))
            assert bool(used) == (deep and name == "cpu")
