"""Malicious and damaged files are refused in one sentence, and nothing in them is executed."""

import builtins
import os
import pickle
import pickletools
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from imitations import SMALL, WRITERS, torchvision_names

from jaxsfm.errors import UserError
from jaxsfm.weights_conversion.convert import LEGACY_TORCH, read_source
from jaxsfm.weights_conversion.torch_files import ADMITTED


class _Call:
    """Pickles as a call of `function(*args)`."""

    def __init__(self, function, *args):
        self.call = (function, args)

    def __reduce__(self):
        return self.call


def attacks(proof) -> dict[str, bytes]:
    """Pickles of protocol 2, each of which does something in a careless reader."""
    calls = {
        "os.system": _Call(os.system, f"touch {proof}"),
        "builtins.eval": _Call(builtins.eval, f"open({str(proof)!r}, 'w').close()"),
        "builtins.open": _Call(open, str(proof), "w"),
        "numpy.fromfile": _Call(np.fromfile, str(proof)),
    }
    made = {name: pickle.dumps({"a": call}, protocol=2) for name, call in calls.items()}
    return made | {
        "torch.load": b"\x80\x02ctorch\nload\n)R.",
        "torch.BFloat16Storage": b"\x80\x02ctorch\nBFloat16Storage\n.",
        "torch._utils.__builtins__": b"\x80\x02ctorch._utils\n__builtins__\n.",
        "collections.OrderedDict.fromkeys": (
            b"\x80\x04\x8c\x0bcollections\x8c\x14OrderedDict.fromkeys\x93."
        ),
    }


def in_zip(path, data: bytes):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", data)
    return path


def in_legacy(path, data: bytes):
    heads = [pickle.dumps(head, protocol=2) for head in (1001, {"little_endian": True})]
    path.write_bytes(LEGACY_TORCH + b"".join(heads) + data + pickle.dumps([], protocol=2))
    return path


@pytest.mark.parametrize("wrap", [in_zip, in_legacy])
@pytest.mark.parametrize("name", attacks(""))
def test_a_pickle_that_names_anything_else_is_refused_unlooked(tmp_path, name, wrap):
    proof = tmp_path / "executed"
    data = attacks(proof)[name]
    path = wrap(tmp_path / "evil.pth", data)
    with pytest.raises(UserError, match="evil.pth: not a readable PyTorch.*is not allowed"):
        read_source(path)
    assert not proof.exists()
    if name in ("os.system", "builtins.eval"):
        pickle.loads(data)  # the attack is real
        assert proof.exists()


@pytest.mark.parametrize("wrap", [in_zip, in_legacy])
@pytest.mark.parametrize("module, name", ADMITTED)
def test_what_is_admitted_cannot_be_changed_by_a_pickle(tmp_path, wrap, module, name):
    before = {key: (value, repr(vars(type(value)))) for key, value in ADMITTED.items()}
    for state in ({"__defaults__": (1,)}, (None, {"__defaults__": (1,)})):
        built = pickle.dumps(state, protocol=2)[2:-1]
        data = b"\x80\x02c" + f"{module}\n{name}\n".encode() + built + b"b."
        with pytest.raises(UserError, match="not a readable PyTorch"):
            read_source(wrap(tmp_path / "evil.pth", data))
    assert before == {key: (value, repr(vars(type(value)))) for key, value in ADMITTED.items()}
    assert not hasattr(ADMITTED[module, name], "__defaults__")


def tensor(size: tuple, stride: tuple, *, elements: int, offset: int = 0) -> bytes:
    """A pickle of {'features.0.weight': tensor} whose numbers may lie."""

    def pickled(value) -> bytes:
        return pickle.dumps(value, protocol=2)[2:-1]

    storage = (
        b"(" + pickled("storage") + b"ctorch\nFloatStorage\n" + pickled("0") + pickled("cpu")
        + pickled(elements) + b"tQ"
    )  # fmt: skip
    arguments = b"(" + storage + pickled(offset) + pickled(size) + pickled(stride) + b"t"
    rebuilt = b"ctorch._utils\n_rebuild_tensor\n" + arguments + b"R"
    return b"\x80\x02}" + pickled("features.0.weight") + rebuilt + b"s."


@pytest.mark.parametrize(
    "data",
    [
        tensor((4, 3, 3, 3), (27, 9, 3, 1), elements=107),
        tensor((4, 3, 3, 3), (27, 9, 3, 1), elements=108, offset=1),
        tensor((4, 3, 3, 3), (27, 9, 3, 1), elements=1 << 62),
        tensor((4, 3, 3, 3), (27, 9, 3, 1), elements=-1),
        tensor((4, 3, 3, 3), (-27, 9, 3, 1), elements=108),
        tensor((4, 3, 3, 3), (0, 0, 0, 0), elements=1),
        tensor((1 << 40, 1 << 40), (0, 0), elements=1),
        tensor((4, 3, 3, 3), (1 << 62, 9, 3, 1), elements=108),
        tensor((4, 3, 3), (27, 9, 3, 1), elements=108),
        tensor((4.0, 3, 3, 3), (27, 9, 3, 1), elements=108),
        tensor((0, 3, 3, 3), (27, 9, 3, 1), elements=108),
    ],
)
def test_a_tensor_never_reaches_past_its_storage(tmp_path, data):
    assert list(pickletools.genops(data))  # well-formed: only its numbers lie
    path = in_zip(tmp_path / "lie.pth", data)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("archive/data/0", bytes(4 * 108))
    with pytest.raises(UserError, match="lie.pth: not a readable PyTorch"):
        read_source(path, shapes=SMALL)


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "bomb.pth"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(1 << 26))
    assert path.stat().st_size < 1 << 17
    with pytest.raises(UserError, match="at most 1048576 are expected"):
        read_source(path)


def test_numbers_of_the_other_byte_order_are_refused(files, tmp_path):
    path = tmp_path / "big.pth"
    with zipfile.ZipFile(files["torchvision_zip"]) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            new.writestr(name, b"big" if name.endswith("byteorder") else old.read(name))
    with pytest.raises(UserError, match="not little-endian"):
        read_source(path, shapes=SMALL)


# -- damage ----------------------------------------------------------------------------------------

KNOWN_HEADS = (
    b"PK\x03\x04",
    LEGACY_TORCH,
    b"MATLAB 5.0".ljust(124) + struct.pack("<H2s", 0x0100, b"IM"),
    struct.pack("<Q", 20) + b"{",
)


def outcome(path) -> str:
    """Return converted, or refused if the error names the file; anything else fails."""
    try:
        source = read_source(path, shapes=SMALL)
    except UserError as error:
        assert str(path) in str(error) and "\n" not in str(error).strip()
        return "refused"
    assert [a[0].shape[2:] for a in source.layers.values()]
    return "converted"


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(head=st.sampled_from((b"", *KNOWN_HEADS)), tail=st.binary(max_size=400))
def test_random_bytes_are_refused(tmp_path, head, tail):
    path = tmp_path / "random"
    path.write_bytes(head + tail)
    assert outcome(path) == "refused"


# Each Keras file is read in a process of its own, which is slow, so only a few are tried.
DAMAGED = [name for name in WRITERS if name not in ("keras_theano", "keras_2", "keras_2_theano")]


@pytest.mark.parametrize("name", DAMAGED)
def test_a_truncated_file_is_refused(files, tmp_path, name):
    data = files[name].read_bytes()
    path = tmp_path / "file"
    for share in (0.0, 0.001, 0.5, 0.9):
        path.write_bytes(data[: int(share * len(data))])
        assert outcome(path) == "refused"


@pytest.mark.parametrize("name", DAMAGED)
def test_a_mutated_file_is_converted_or_refused(files, tmp_path, name):
    data, rng = files[name].read_bytes(), np.random.default_rng(0)
    path = tmp_path / "file"
    found = set()
    for k in range(4 if name.startswith("keras") else 60):
        broken = bytearray(data)
        end = len(data) if k % 4 == 0 else 3000  # the structure of a file is in its header
        for at in rng.integers(0, end, rng.integers(1, 6)):
            broken[at] = rng.integers(256)
        path.write_bytes(bytes(broken))
        found.add(outcome(path))
    assert "refused" in found


@pytest.mark.parametrize(
    "script, words",
    [
        ("import time; time.sleep(60)", "not finished after 0.5 s"),
        ("import os; os.abort()", "the HDF5 library crashed"),
        ("raise SystemExit(3)", "the HDF5 library crashed"),
    ],
)
def test_a_file_on_which_the_hdf5_library_loops_or_crashes_is_damaged(
    files, tmp_path, monkeypatch, script, words
):
    from jaxsfm.weights_conversion import keras_files

    child = tmp_path / "child.py"
    child.write_text(script)
    monkeypatch.setattr(keras_files, "CHILD", child)
    monkeypatch.setattr(keras_files, "PATIENCE_S", 0.5 if "sleep" in script else 30.0)
    with pytest.raises(UserError, match=words) as error:
        read_source(files["keras_1"], shapes=SMALL)
    assert str(files["keras_1"]) in str(error.value)


def test_a_file_that_is_not_there_or_a_folder_is_named(tmp_path):
    for path in (tmp_path / "missing.h5", tmp_path):
        with pytest.raises(UserError, match="cannot be read"):
            read_source(path)


def test_extra_entries_of_a_state_dict_do_no_harm(layers, tmp_path):
    from imitations import torch_legacy, torch_zip

    state = {"epoch.weight": np.zeros((2, 2), np.float32), **torchvision_names(layers)}
    for writer in (torch_zip, torch_legacy):
        assert outcome(writer(tmp_path / writer.__name__, state)) == "converted"
