"""Converted weights are loaded as they were saved; anything else is refused by its path."""

import dataclasses
import json

import numpy as np
import pytest
import safetensors.numpy

from jaxsfm.config import preset
from jaxsfm.core.vgg import Preprocessing
from jaxsfm.errors import UserError
from jaxsfm.io import weights
from jaxsfm.io.relocalizer import Relocalizer, save_relocalizer, shipped_relocalizer
from jaxsfm.io.weight_files import FORMAT, is_converted, read_converted, save_weights
from jaxsfm.io.weights import load_weights

SHAPES = {"conv1_1": (3, 2), "conv1_2": (2, 4)}
CAFFE = Preprocessing(1.0, (123.68, 116.779, 103.939), (1.0, 1.0, 1.0))


def layers_of(seed: int = 0) -> dict[str, dict[str, np.ndarray]]:
    rng = np.random.default_rng(seed)
    return {
        name: {
            "kernel": rng.normal(size=(3, 3, i, o)).astype(np.float32),
            "bias": rng.normal(size=o).astype(np.float32),
        }
        for name, (i, o) in SHAPES.items()
    }


@pytest.fixture
def good(tmp_path):
    path = tmp_path / "good.safetensors"
    about = {"source": "a.h5", "source_sha256": "00"}
    save_weights(
        path,
        layers_of(),
        extras={},
        architecture="vgg16",
        family="keras",
        preprocessing=CAFFE,
        about=about,
    )
    return path


def test_what_is_saved_is_loaded(good):
    assert is_converted(good)
    found = read_converted(good, shapes=SHAPES)
    for name, layer in layers_of().items():
        assert all(np.array_equal(found.layers[name][part], layer[part]) for part in layer)
    assert (found.family, found.preprocessing) == ("keras", CAFFE)
    assert found.about["source"] == "a.h5" and found.about["architecture"] == "vgg16"


def test_a_wrong_file_is_refused_by_its_path(good, tmp_path):
    tensors = safetensors.numpy.load(good.read_bytes())
    with safetensors.safe_open(good, framework="numpy") as file:
        about = json.loads(file.metadata()[FORMAT])

    def made(arrays=(), **changes) -> bytes:
        new = {k: v for k, v in {**tensors, **dict(arrays)}.items() if v is not None}
        return safetensors.numpy.save(new, {FORMAT: json.dumps({**about, **changes})})

    nan = np.full(4, np.nan, np.float32)
    usual = CAFFE._asdict()
    cases = {
        "missing": (None, "cannot read"),
        "truncated": (good.read_bytes()[:-4], "not a readable safetensors"),
        "relocalizer": (safetensors.numpy.save(tensors, {"x": "y"}), "not a weights file"),
        "lacking": (made({"conv1_2.bias": None}), "conv1_2.bias is missing"),
        "shape": (made({"conv1_2.bias": np.zeros(5, np.float32)}), r"must be float32 \(4,\)"),
        "double": (made({"conv1_2.bias": np.zeros(4)}), "conv1_2.bias must be float32"),
        "nan": (made({"conv1_2.bias": nan}), "conv1_2.bias has values"),
        "more": (made({"conv9_9.bias": nan}), "conv9_9.bias does not belong"),
        "extra": (made({"netvlad.centres": nan}), r"netvlad.centres must be float32 \(512, 64\)"),
        "family": (made(family="alexnet"), "its family must be torchvision or"),
        "unhashable": (made(family=["keras"]), "its family must be torchvision or"),
        "architecture": (made(architecture="vgg20"), "its architecture must be vgg16 or vgg19"),
        "no mean": (made(preprocessing={"scale": 1}), "its preprocessing cannot be used"),
        "zero": (made(preprocessing={**usual, "std": [1, 0, 1]}), "preprocessing cannot be used"),
        "words": (made(preprocessing={**usual, "mean": "abc"}), "preprocessing cannot be used"),
        "two": (made(preprocessing={**usual, "mean": [1, 2]}), "preprocessing cannot be used"),
        "infinite": (made(preprocessing={**usual, "scale": 1e999}), "preprocessing cannot be"),
        "list": (safetensors.numpy.save(tensors, {FORMAT: "[]"}), "not a weights file"),
    }
    for name, (content, words) in cases.items():
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(UserError, match=words) as error:
            read_converted(path, shapes=SHAPES)
        assert str(path) in str(error.value)


def test_mutated_files_load_or_are_refused(good):
    data, rng = good.read_bytes(), np.random.default_rng(0)
    for _ in range(200):
        broken = bytearray(data)
        for at in rng.integers(0, 900, rng.integers(1, 4)):
            broken[at] = rng.integers(256)
        good.write_bytes(
            bytes(broken[: rng.integers(1, len(data)) if rng.random() < 0.2 else None])
        )
        try:
            found = read_converted(good, shapes=SHAPES)
        except UserError:
            continue
        assert all(np.isfinite(a).all() for layer in found.layers.values() for a in layer.values())


# -- relocalizers belong to weights ----------------------------------------------------------------


def other_weights(layer: str, monkeypatch_params=None) -> weights.Weights:
    """The installed weights with one number changed."""
    loaded = load_weights()
    tree = dict(loaded.params["params"])
    bias = tree[layer]["bias"].copy()
    bias[0] += 1e-3
    tree[layer] = {**tree[layer], "bias": bias}
    return dataclasses.replace(loaded, params={"params": tree}, sha256="other")


LEARNED = dataclasses.replace(preset("default"), keypoints="learned")


@pytest.mark.parametrize("layer", ["conv1_1", "conv1_2", "conv2_1", "conv2_2"])
def test_a_relocalizer_of_other_lower_layers_is_refused_where_it_is_used(layer):
    other = other_weights(layer)
    with pytest.raises(UserError, match="jaxsfm's own relocalizer was trained on other weights"):
        other.scores(LEARNED)
    assert other.scores(preset("default")) is None


def test_a_relocalizer_of_another_preprocessing_is_refused():
    other = dataclasses.replace(load_weights(), preprocessing=CAFFE)
    with pytest.raises(UserError, match="trained on other weights"):
        other.scores(LEARNED)


def test_layers_that_no_relocalizer_sees_may_differ():
    other = other_weights("conv3_1")
    assert other.scores(LEARNED) is shipped_relocalizer().params


def test_a_given_relocalizer_is_compared_by_what_it_says_of_itself(tmp_path):
    other, shipped = other_weights("conv1_1"), shipped_relocalizer()
    for about, fits in (({"walked": other.walked}, True), ({}, True), (shipped.about, False)):
        path = tmp_path / "a.safetensors"
        save_relocalizer(path, shipped.params, about)
        given = Relocalizer(params=shipped.params, sha256="", about=about)
        chosen = dataclasses.replace(other, relocalizer=given)
        if fits:
            assert chosen.learned is given
        else:
            with pytest.raises(UserError, match="the given relocalizer was trained on other"):
                _ = chosen.learned
