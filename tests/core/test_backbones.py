"""Laws of the networks that can stand in for VGG-16."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import tolerances
from compiled import compiled

from jaxsfm.config import BackboneName, Config
from jaxsfm.core.alexnet import AlexNet
from jaxsfm.core.features import BACKBONES, Extraction, extract
from jaxsfm.core.scores import Head
from jaxsfm.core.vgg import LAYERS, Preprocessing

PLAIN = Preprocessing(scale=64.0, mean=(2.0, 1.5, 1.0), std=(1.0, 1.0, 1.0))


def random_params(name, seed=0):
    """Of He's spread, so that no map dies out or runs away."""
    rng = np.random.default_rng(seed)
    layers = {}
    for layer, shape in BACKBONES[name].kernels.items():
        spread = np.sqrt(2 / np.prod(shape[:3]))
        layers[layer] = {
            "kernel": rng.normal(0, spread, shape).astype(np.float32),
            "bias": rng.normal(0, 0.1, shape[3]).astype(np.float32),
        }
    return {"params": layers}


@functools.cache
def program(name):
    return compiled(functools.partial(BACKBONES[name].module().apply, method="levels"))


def levels(name, params, images, sizes):
    return program(name)(params, images, np.int32(sizes))


def assert_equal_inside(ours, expected):
    """What is past the expected map's size is zero."""
    rows, cols = expected.shape[:2]
    scale = np.abs(expected).max(initial=1e-6)
    np.testing.assert_allclose(ours[:rows, :cols] / scale, expected / scale, **tolerances.FEATURES)
    assert not ours[rows:].any() and not ours[:, cols:].any()


@pytest.fixture(scope="module")
def image():
    return np.random.default_rng(1).normal(0, 1, (64, 48, 3)).astype(np.float32)


@pytest.mark.parametrize("size", [(64, 48), (53, 47), (35, 33), (9, 48)])
def test_alexnet_equals_window_by_window_sums_whatever_lies_in_the_padding(image, size):
    h, w = size
    padded = np.full(image.shape, 7.0, np.float32)
    padded[:h, :w] = image[:h, :w]
    params = random_params("alexnet")
    ours = levels("alexnet", params, padded[None], [size])
    maps = oracles.alexnet(params, image[:h, :w])
    for score, name in zip(ours.scores, ("conv1", "two", "four"), strict=True):
        assert_equal_inside(score[0], (maps[name] ** 2).sum(-1))
    assert_equal_inside(ours.pool3[0], maps["conv2"])
    assert_equal_inside(ours.pool4[0], maps["conv5"])


def test_alexnets_strips_give_the_same_for_any_height(image, monkeypatch):
    params = random_params("alexnet")
    expected = levels("alexnet", params, image[None], [(50, 40)])
    monkeypatch.setattr("jaxsfm.core.alexnet.STRIP_ROWS", 64)
    jax.clear_caches()  # what was compiled before has other strips
    ours = levels("alexnet", params, image[None], [(50, 40)])
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * np.abs(b).max())
    jax.clear_caches()


def test_alexnet_takes_no_learned_scores():
    head = Head(*(np.zeros(shape, np.float32) for shape in ((64, 2), 2, 2, (8, 8))))
    with pytest.raises(ValueError, match="heads"):
        jax.eval_shape(
            functools.partial(AlexNet().apply, method="levels"),
            random_params("alexnet"),
            np.zeros((1, 16, 16, 3), np.float32),
            np.int32([[16, 16]]),
            (head, None, None),
        )


@pytest.mark.parametrize("name", BACKBONES)
def test_a_backbone_tells_its_layers_and_channels(name):
    backbone = BACKBONES[name]
    shapes = jax.eval_shape(
        functools.partial(backbone.module().init, method="levels"),
        jax.random.key(0),
        jax.ShapeDtypeStruct((1, 32, 32, 3), jnp.float32),
        jax.ShapeDtypeStruct((1, 2), jnp.int32),
    )["params"]
    kernels = {layer: value["kernel"].shape for layer, value in shapes.items()}
    assert kernels == {layer: backbone.kernels[layer] for layer in kernels}
    found = jax.eval_shape(
        functools.partial(backbone.module().apply, method="levels"),
        random_params(name),
        jax.ShapeDtypeStruct((2, 32, 48, 3), jnp.float32),
        jax.ShapeDtypeStruct((2, 2), jnp.int32),
    )
    assert [s.shape for s in found.scores] == [(2, 32, 48), (2, 16, 24), (2, 8, 12)]
    assert found.pool3.shape == (2, 4, 6, backbone.fine)
    assert found.pool4.shape == (2, 2, 3, backbone.coarse)


def test_vgg19_is_vgg16_where_its_further_layers_pass_everything_on(image):
    """Their kernels the identity: what comes in is rectified already."""
    params = random_params("vgg16")
    identity = {}
    for block, width in ((3, 256), (4, 512), (5, 512)):
        kernel = np.zeros((3, 3, width, width), np.float32)
        kernel[1, 1] = np.eye(width)
        identity[f"conv{block}_4"] = {"kernel": kernel, "bias": np.zeros(width, np.float32)}
    deeper = {"params": {**params["params"], **identity}}
    assert set(deeper["params"]) == set(BACKBONES["vgg19"].kernels) and len(LAYERS) == 13
    sixteen = levels("vgg16", params, image[None], [(64, 48)])
    nineteen = levels("vgg19", deeper, image[None], [(64, 48)])
    for a, b in zip(jax.tree.leaves(sixteen), jax.tree.leaves(nineteen), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5 * np.abs(a).max())


@pytest.mark.parametrize("name", BACKBONES)
def test_features_are_made_of_any_backbone_with_octaves(name, image):
    rgb = np.clip(128 + 40 * image, 0, 255).astype(np.uint8)
    settings = Extraction(PLAIN, num_coarse=12, backbone=name, octaves=2, centred=True)
    features = jax.device_get(
        extract(random_params(name), rgb, np.int32([64, 48]), settings=settings)
    )
    backbone = BACKBONES[name]
    assert [f.shape for f in features.fine] == [(48, backbone.fine), (12, backbone.fine)]
    assert features.coarse[0].shape == (12, backbone.coarse)
    np.testing.assert_allclose(np.linalg.norm(features.fine[0], axis=1), 1, rtol=1e-5)
    xy = features.keypoints.reshape(8, 6, 2)
    cells = np.stack(np.meshgrid(np.arange(6), np.arange(8)), -1)
    assert (xy // 8 == cells).all()  # every keypoint lies in its own cell


def test_configurations_know_the_backbones_there_are():
    assert set(BACKBONES) == set(BackboneName.__args__)
    with pytest.raises(ValueError, match="backbone"):
        Config(backbone="resnet")  # pyright: ignore[reportArgumentType]
    for name, backbone in BACKBONES.items():
        if name != "vgg16":  # a relocalizer belongs to the maps it was trained on
            with pytest.raises(ValueError, match="learned"):
                Config(backbone=name, keypoints="learned")  # pyright: ignore[reportArgumentType]
        assert Config(backbone=name).extraction().backbone == name  # pyright: ignore[reportArgumentType]
        assert backbone.fine > 0


def test_relocalizers_are_learned_for_vgg16_alone():
    assert {name: b.learned for name, b in BACKBONES.items()} == {
        "vgg16": True,
        "vgg19": False,
        "alexnet": False,
    }
