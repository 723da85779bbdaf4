"""Laws of the feature pyramid."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import tolerances
from compiled import compiled

from jaxsfm.core import blocks
from jaxsfm.core import vgg as core
from jaxsfm.core.pair_shape import FINE_STRIDES, PAPER_LAYERS
from jaxsfm.core.types import Pyramid
from jaxsfm.core.vgg import LAYERS, VGG16, Preprocessing, init_shapes
from jaxsfm.core.winograd import conv3x3
from jaxsfm.io.weights import TORCHVISION

program, pool = compiled(VGG16().apply, "method", "layers"), compiled(blocks.pool)
preprocess = compiled(core.preprocess, "p")


def apply(params, images, sizes, **method):
    """The pyramid, or what another method of the network gives."""
    return program(params, images, np.int32(sizes), **method)


def assert_maps_equal(ours, expected):
    scale = max(np.abs(expected).max(), 1e-6)
    np.testing.assert_allclose(ours / scale, expected / scale, **tolerances.FEATURES)


@pytest.fixture(scope="module")
def photo(photos):
    return preprocess(photos[0][100:164, 80:160], p=TORCHVISION)


def test_every_level_equals_an_independent_convolution(weights, photo):
    maps = apply(weights.params, photo[None], [photo.shape[:2]])
    for name, ours, expected in zip(
        Pyramid._fields, maps, oracles.vgg(weights.params, photo), strict=True
    ):
        assert ours.shape[1:] == expected.shape, name
        assert_maps_equal(ours[0], expected)


@pytest.mark.parametrize("size", [(64, 80), (57, 71), (49, 66)])
def test_padding_an_image_does_not_change_its_features(weights, photo, size):
    h, w = size
    padded = np.full((64, 80, 3), 7.0, np.float32)  # whatever lies in the padding
    padded[:h, :w] = photo[:h, :w]
    ours = apply(weights.params, padded[None], [size])
    expected = oracles.vgg(weights.params, photo[:h, :w])
    for level, (map_, reference) in enumerate(zip(ours, expected, strict=True)):
        rows, cols = reference.shape[:2]
        assert_maps_equal(map_[0, :rows, :cols], reference)
        assert not map_[0, rows:].any() and not map_[0, :, cols:].any(), level


@pytest.mark.parametrize("size", [(64, 80), (57, 71), (33, 66), (9, 80)])
def test_levels_are_the_pyramid_without_its_largest_maps(weights, photo, size):
    """On CPUs by strips: images that end inside one, at its edge, before the first ends."""
    images, sizes = np.stack([photo, photo[::-1]]), [size, (64, 80)]
    maps = apply(weights.params, images, sizes)
    levels = apply(weights.params, images, sizes, method="levels")
    for ours, expected in zip(levels.scores, (maps.conv1_2, maps.pool1, maps.pool2), strict=True):
        assert_maps_equal(ours, np.square(expected).sum(-1))
    assert_maps_equal(levels.pool3, maps.pool3)
    assert_maps_equal(levels.pool4, maps.pool4)


@pytest.mark.slow
def test_bfloat16_rounds_operands_and_results_and_adds_in_float32(weights, photo):
    """One layer exactly; the network as bfloat16's eight bits let it."""
    x, layer = jnp.asarray(photo[None]), weights.params["params"]["conv1_1"]
    kernel = jnp.asarray(layer["kernel"])
    ours = blocks.conv(x, blocks.Layer(kernel, jnp.asarray(layer["bias"])), bfloat16=True)
    low = [np.asarray(a.astype(jnp.bfloat16).astype(jnp.float32)) for a in (x[0], kernel)]
    exact = jnp.asarray(oracles.convolution(*low, np.zeros(64)), jnp.float32)
    expected = np.asarray(exact.astype(jnp.bfloat16).astype(jnp.float32)) + layer["bias"]
    # Half-way between two of bfloat16's numbers float32's sum may choose the other.
    assert (np.asarray(ours[0]) == expected).mean() > 0.999
    images, sizes = jnp.asarray(photo[None]), jnp.asarray([photo.shape[:2]], jnp.int32)
    exact = VGG16().apply(weights.params, images, sizes, method="levels")
    half = VGG16(bfloat16=True).apply(weights.params, images, sizes, method="levels")
    for name in ("pool3", "pool4"):
        a, b = (np.asarray(getattr(maps, name)) for maps in (exact, half))
        apart = np.linalg.norm(a - b) / np.linalg.norm(a)
        assert 1e-4 < apart < 0.02, name


@pytest.mark.parametrize("rows", [*(pytest.param(n, marks=pytest.mark.slow) for n in (1, 100)), 64])
def test_strips_of_any_height_give_the_same(weights, photo, monkeypatch, rows):
    def levels():
        jax.clear_caches()  # what was compiled before has other strips
        return apply(weights.params, photo[None], [[50, 70]], method="levels")

    expected = levels()
    monkeypatch.setattr(blocks, "STRIP_ROWS", 2 * rows)
    for ours, want in zip(jax.tree.leaves(levels()), jax.tree.leaves(expected), strict=True):
        assert_maps_equal(ours, want)
    jax.clear_caches()


def test_a_batch_is_its_images_one_by_one(weights, photo):
    images = np.stack([photo, photo[::-1]])
    sizes = [(64, 80), (40, 80)]
    batch = apply(weights.params, images, sizes)
    for i in range(2):
        single = apply(weights.params, images[i : i + 1], sizes[i : i + 1])
        for a, b in zip(batch, single, strict=True):
            assert_maps_equal(a[i], b[0])


@pytest.mark.slow
def test_jit_equals_eager(weights, photo):
    small = photo[None, :32, :32]
    sizes = jnp.asarray([[32, 32]], jnp.int32)
    eager = VGG16().apply(weights.params, jnp.asarray(small), sizes)
    for a, b in zip(apply(weights.params, small, sizes), eager, strict=True):
        assert_maps_equal(a, np.asarray(b))


def test_the_parameter_tree_has_the_thirteen_canonical_layers():
    shapes = init_shapes()["params"]
    assert set(shapes) == set(LAYERS) and len(LAYERS) == 13
    for name, (inputs, outputs) in LAYERS.items():
        assert shapes[name]["kernel"].shape == (3, 3, inputs, outputs)


def test_preprocessing_is_scale_then_mean_then_std():
    p = Preprocessing(scale=2.0, mean=(1.0, 2.0, 3.0), std=(1.0, 2.0, 4.0))
    out = preprocess(np.full((1, 1, 3), 10, np.uint8), p=p)
    np.testing.assert_allclose(out[0, 0], [4.0, 1.5, 0.5])


@pytest.mark.slow
def test_both_convolutions_give_the_same_maps(weights, photo, monkeypatch):
    """On CPUs; elsewhere it compares the library's with itself."""
    sizes = [photo.shape[:2]]
    library = apply(weights.params, photo[None], sizes)
    monkeypatch.setattr(blocks, "WINOGRAD_PRODUCTS", 1)
    monkeypatch.setattr(blocks, "WINOGRAD_CHANNELS", 1)
    used = []
    monkeypatch.setattr(blocks, "conv3x3", lambda x, k: (used.append(x.shape), conv3x3(x, k))[1])
    jax.clear_caches()  # what was compiled before has the library's convolution
    for ours, expected in zip(apply(weights.params, photo[None], sizes), library, strict=True):
        assert_maps_equal(ours, np.asarray(expected))
    assert len(used) == len(LAYERS)
    jax.clear_caches()


@pytest.mark.parametrize("layers", [name for name in FINE_STRIDES if name != PAPER_LAYERS])
def test_other_pairs_of_layers_are_maps_of_the_same_network(weights, photo, layers):
    """A convolution's map, pooled, is the pyramid's; scores are norms of what lies below."""
    size, stride = (57, 71), FINE_STRIDES[layers]
    images, sizes = photo[None], np.int32([size])
    pyramid = apply(weights.params, images, sizes)
    found = apply(weights.params, images, sizes, method="levels", layers=layers)
    for name, ours in zip(layers.split("/"), (found.pool4, found.pool3), strict=True):
        pooled = getattr(pyramid, f"pool{name[4]}")
        if name.startswith("conv"):
            assert np.any(ours < 0)
            ours = pool(ours, sizes // 2 ** (int(name[4]) - 1))
        assert_maps_equal(ours, pooled)
    assert found.pool3.shape[1] == photo.shape[0] // stride
    assert len(found.scores) == stride.bit_length() - 1
    for score, below in zip(found.scores, pyramid, strict=False):
        assert_maps_equal(score, np.square(below).sum(axis=-1))


def test_the_last_convolution_is_what_pool5_pools(weights, photo):
    size = (57, 71)
    images, sizes = photo[None], np.int32([size])
    last = apply(weights.params, images, sizes, method="conv5")
    rows, cols = size[0] // 16, size[1] // 16
    assert not np.any(last[:, rows:]) and not np.any(last[:, :, cols:]) and np.any(last < 0)
    expected = apply(weights.params, images, sizes).pool5
    assert_maps_equal(pool(last, sizes // 16), expected)
