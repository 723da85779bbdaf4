"""A file of weights is known or refused, and nothing in it is executed."""

import builtins
import os
import pickle

import numpy as np
import pytest

from jaxsfm.config import Config
from jaxsfm.core.alexnet import KERNELS
from jaxsfm.core.vgg import LAYERS
from jaxsfm.errors import UserError
from jaxsfm.io import weights
from jaxsfm.io.known_weights import VGG16, find_weights
from jaxsfm.io.weight_files import save_weights
from jaxsfm.io.weights import load_weights, read_arrays
from jaxsfm.matching.extraction import extraction_settings


def test_the_default_weights_are_the_thirteen_known_layers():
    loaded = load_weights()
    layers = loaded.params["params"]
    assert list(layers) == list(LAYERS) and len(layers) == 13
    for name, (inputs, outputs) in LAYERS.items():
        assert layers[name]["kernel"].shape == (3, 3, inputs, outputs)
        assert layers[name]["bias"].shape == (outputs,)
        assert all(array.dtype == np.float32 for array in layers[name].values())
    assert layers["conv1_1"]["kernel"][0, 0, 0, 0] == pytest.approx(-0.5537306, abs=1e-6)
    assert loaded.sha256 == VGG16 and loaded.preprocessing.scale == 255.0


def test_alexnets_weights_come_with_the_same_distribution(tmp_path):
    loaded = load_weights(backbone="alexnet")
    layers = loaded.params["params"]
    assert {n: layer["kernel"].shape for n, layer in layers.items()} == KERNELS
    assert loaded.backbone == "alexnet" and loaded.sha256 != VGG16
    with pytest.raises(UserError, match="damaged"):
        load_weights(find_weights("alexnet")[0])  # of another network than asked for
    with pytest.raises(UserError, match="no learned keypoints with alexnet"):
        _ = loaded.learned
    with pytest.raises(UserError, match="--backbone vgg19.*--weights"):
        load_weights(backbone="vgg19")


def test_converted_weights_of_another_network_are_refused(tmp_path):
    loaded = load_weights()
    path = tmp_path / "vgg16.safetensors"
    save_weights(
        path,
        loaded.params["params"],
        extras={},
        architecture="vgg16",
        family="torchvision",
        preprocessing=loaded.preprocessing,
        about={"source": "a test"},
    )
    assert load_weights(path).backbone == "vgg16"
    with pytest.raises(UserError, match="holds weights of vgg16, but --backbone is alexnet"):
        load_weights(path, backbone="alexnet")
    config = Config(backbone="alexnet")
    with pytest.raises(ValueError, match="weights must be of alexnet; got vgg16"):
        extraction_settings(loaded, config, 12)


def test_a_copy_of_the_file_loads_from_anywhere(tmp_path):
    copy = tmp_path / "copy of vgg.ckpt"
    copy.symlink_to(find_weights("vgg16")[0])
    ours, theirs = load_weights(copy).params["params"], load_weights().params["params"]
    assert np.array_equal(ours["conv5_3"]["bias"], theirs["conv5_3"]["bias"])


def test_a_truncated_wrong_or_missing_file_is_refused_by_its_path(tmp_path):
    data = find_weights("vgg16")[1]
    cases = {
        "truncated.ckpt": data[:1_000_000],
        "wrong.ckpt": pickle.dumps({"VGG16_0": {}}),
        "flipped.ckpt": data[:-5] + bytes([data[-5] ^ 1]) + data[-4:],
        "empty.ckpt": b"",
        "missing.ckpt": None,
    }
    for name, content in cases.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError) as error:
            load_weights(tmp_path / name)
        message = str(error.value)
        assert str(tmp_path / name) in message and "jaxsfm weights convert" in message
        assert ("cannot read" if content is None else "damaged") in message


def test_the_hash_is_compared_before_the_pickle_is_opened(tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "read_arrays", lambda *a, **k: pytest.fail("opened"))
    (tmp_path / "bad.ckpt").write_bytes(b"anything")
    with pytest.raises(UserError, match="SHA-256"):
        load_weights(tmp_path / "bad.ckpt")


class _Call:
    """Pickles as a call of `function(*args)`."""

    def __init__(self, function, *args):
        self.call = (function, args)

    def __reduce__(self):
        return self.call


def attacks(proof) -> dict[str, object]:
    return {
        "os.system": _Call(os.system, f"touch {proof}"),
        "builtins.eval": _Call(builtins.eval, f"open({str(proof)!r}, 'w').close()"),
        "builtins.getattr": _Call(getattr, _Call(np.dtype, "f4"), "newbyteorder"),
        "numpy.fromfile": _Call(np.fromfile, str(proof)),
    }


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("name", attacks(""))
def test_a_pickle_that_calls_something_is_refused_without_calling_it(tmp_path, name, protocol):
    proof = tmp_path / "executed"
    data = pickle.dumps({"VGG16_0": [np.zeros(3), attacks(proof)[name]]}, protocol=protocol)
    with pytest.raises(UserError, match="model.ckpt: not a readable weights file"):
        read_arrays(data, path="model.ckpt")
    assert not proof.exists()
    if name in ("os.system", "builtins.eval"):
        pickle.loads(data)  # the attack is real
        assert proof.exists()


def test_a_dotted_name_below_an_admitted_one_is_refused():
    data = b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93."
    with pytest.raises(UserError, match="not allowed"):
        read_arrays(data, path="model.ckpt")


@pytest.mark.parametrize("protocol", [3, 4])
def test_a_pickle_of_arrays_reads_as_it_was(protocol):
    tree = {"a": [np.arange(6, dtype=np.float32).reshape(2, 3)], "b": {"c": np.asarray([1, 2])}}
    got = read_arrays(pickle.dumps(tree, protocol=protocol), path="x")
    assert np.array_equal(got["a"][0], tree["a"][0]) and got["a"][0].dtype == np.float32
    assert np.array_equal(got["b"]["c"], tree["b"]["c"])


@pytest.mark.parametrize("data", [b"", b"text", pickle.dumps(np.zeros(100), protocol=4)[:-50]])
def test_damaged_bytes_are_refused(data):
    with pytest.raises(UserError, match="model.ckpt: not a readable weights file"):
        read_arrays(data, path="model.ckpt")
