"""Damaged safetensors files: the parameters, or one sentence that names the file."""

import json
import struct

import numpy as np
from fuzz_children import run_cases
from imitations import SMALL, random_layers
from mutations import damaged, damaged_json, outcome

from jaxsfm.core.vgg import Preprocessing
from jaxsfm.io.relocalizer import load_relocalizer, save_relocalizer, shipped_relocalizer
from jaxsfm.io.weight_files import read_converted, save_weights

NEUTRAL = Preprocessing(1.0, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def whole(folder, what: str):
    """A file, made once, and how it is read."""
    path = folder / f"{what}.whole"
    if what == "relocalizer":
        if not path.exists():
            shipped = shipped_relocalizer()
            save_relocalizer(path, shipped.params, shipped.about)
        return path, load_relocalizer
    if not path.exists():
        layers = {n: {"kernel": k, "bias": b} for n, (k, b) in random_layers().items()}
        about = {"source": "a.caffemodel"}
        save_weights(
            path,
            layers,
            extras={},
            architecture="vgg16",
            family="caffe",
            preprocessing=NEUTRAL,
            about=about,
        )
    return path, lambda bad: read_converted(bad, shapes=SMALL)


def with_header(data: bytes, rng) -> bytes:
    """The header, JSON, with values of other types; its length is right."""
    length = int.from_bytes(data[:8], "little")
    header = damaged_json(json.loads(data[8 : 8 + length]), rng)
    return struct.pack("<Q", len(header)) + header + data[8 + length :]


def tensors(rng, folder) -> str:
    path, read = whole(folder, ["relocalizer", "weights"][rng.integers(2)])
    bad = folder / "bad.safetensors"
    data = path.read_bytes()
    bad.write_bytes(with_header(data, rng) if rng.random() < 0.5 else damaged(data, rng))
    how, found = outcome(lambda: read(bad), bad)
    if how == "read":
        layers = found.params["params"] if hasattr(found, "params") else found.layers
        assert all(
            array.dtype == np.float32 and np.isfinite(array).all()
            for parts in layers.values()
            for array in parts.values()
        )
    return how


def test_damaged_parameters_are_read_or_refused_by_name(tmp_path, share):
    found = run_cases("test_fuzz_weights", "tensors", round(300 * share), tmp_path)
    assert found["read"] > 10 * share and found["refused"] > 100 * share
