"""A file of learned scores is read as it was written; anything else is refused by its path."""

import json
import pickle

import jax
import numpy as np
import pytest
import safetensors.numpy

from jaxsfm.config import preset
from jaxsfm.core.scores import WALKED, init_scores
from jaxsfm.errors import UserError
from jaxsfm.io.relocalizer import FORMAT, load_relocalizer, save_relocalizer
from jaxsfm.io.weights import load_weights


@pytest.fixture
def params() -> dict:
    return jax.device_get(init_scores(jax.random.key(1), hidden=4))


def tensors_of(path) -> dict[str, np.ndarray]:
    return safetensors.numpy.load(path.read_bytes())


def test_what_is_saved_is_loaded(tmp_path, params):
    path = tmp_path / "a.safetensors"
    about = {"seed": 3, "nested": {"words": ["night", "日"]}}
    save_relocalizer(path, params, about)
    loaded = load_relocalizer(path)
    assert loaded.about == about
    assert jax.tree.all(jax.tree.map(np.array_equal, loaded.params, params))


def test_the_same_parameters_give_the_same_bytes(tmp_path, params):
    for name in "ab":
        save_relocalizer(tmp_path / name, params, {"y": 1, "x": 2})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert load_relocalizer(tmp_path / "a").sha256 == load_relocalizer(tmp_path / "b").sha256


def test_a_wrong_file_is_refused_by_its_path(tmp_path, params):
    good = tmp_path / "good.safetensors"
    save_relocalizer(good, params, {})
    data, tensors = good.read_bytes(), tensors_of(good)
    marked = {FORMAT: json.dumps({})}

    def made(metadata=marked, **changes) -> bytes:
        new = {k: v for k, v in {**tensors, **changes}.items() if v is not None}
        return safetensors.numpy.save(new, metadata=metadata)

    cases = {
        "missing": (None, "cannot read"),
        "empty": (b"", "not a readable safetensors"),
        "truncated": (data[:-10], "not a readable safetensors"),
        "pickle": (pickle.dumps({"a": 1}), "not a readable safetensors"),
        "other": (made({"format": "pt"}), "not a relocalizer"),
        "words": (made({FORMAT: "{"}), "not a readable safetensors"),
        "lacking": (made(**{"pool1.out": None}), "pool1.out is missing"),
        "more": (made(**{"pool9.out": np.zeros(3, np.float32)}), "pool9.out does not belong"),
        "shape": (made(**{"pool2.kernel": np.zeros((3, 4), np.float32)}), "pool2.kernel must be"),
        "double": (made(**{"pool2.out": np.zeros(4)}), "pool2.out must be float32"),
        "nan": (made(**{"conv1_2.bias": np.full(4, np.nan, np.float32)}), "not finite"),
        "units": (made(**{"pool1.bias": np.zeros(0, np.float32)}), "1 to 1024 units"),
    }
    for name, (content, words) in cases.items():
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(UserError, match=words) as error:
            load_relocalizer(path)
        assert str(path) in str(error.value)


def test_mutated_files_load_or_are_refused(tmp_path, params):
    path = tmp_path / "a.safetensors"
    save_relocalizer(path, params, {"seed": 1})
    data, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(200):
        broken = bytearray(data)
        for at in rng.integers(0, 700, rng.integers(1, 4)):
            broken[at] = rng.integers(256)
        path.write_bytes(
            bytes(broken[: rng.integers(1, len(data)) if rng.random() < 0.2 else None])
        )
        try:
            loaded = load_relocalizer(path)
        except UserError:
            continue
        assert set(loaded.params["params"]) == set(WALKED)


def test_only_learned_keypoints_use_scores(tmp_path, params):
    path = tmp_path / "a.safetensors"
    save_relocalizer(path, params, {})
    weights = load_weights(relocalizer=path)
    from dataclasses import replace

    assert weights.scores(preset("paper")) is None
    assert weights.scores(replace(preset("default"), keypoints="relocalized")) is None
    assert weights.scores(replace(preset("paper"), keypoints="grid")) is None
    chosen = weights.scores(replace(preset("paper"), keypoints="learned"))
    assert np.array_equal(chosen["params"]["pool1"]["kernel"], params["params"]["pool1"]["kernel"])


def test_a_file_that_cannot_be_written_is_named(tmp_path, params):
    with pytest.raises(UserError, match="cannot be written"):
        save_relocalizer(tmp_path / "no folder" / "a.safetensors", params, {})
