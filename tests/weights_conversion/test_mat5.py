"""MATLAB's files of version 5 are read as scipy reads them; objects in them are left out."""

import struct

import numpy as np
import pytest
import scipy.io
from imitations import SMALL, cell, matconvnet, random_layers

from jaxsfm.weights_conversion.convert import read_source
from jaxsfm.weights_conversion.mat5 import MAX_DEPTH, read_variables

TYPES = ["f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]


@pytest.mark.parametrize("compressed", [False, True])
def test_numbers_texts_cells_and_structs_are_read_as_scipy_reads_them(tmp_path, compressed):
    rng = np.random.default_rng(0)
    arrays = {t: (50 * rng.normal(size=(3, 4, 2, 5))).astype(t) for t in TYPES}
    inner = {"text": "night", "cell": cell([arrays["f4"], "b", cell([1.0, 2.0])]), "n": 7}
    many = np.empty((1, 2), object)
    many[0, 0], many[0, 1] = {"a": 1.0}, {"a": 2.0}
    path = tmp_path / "a.mat"
    scipy.io.savemat(
        path, {**arrays, "inner": inner, "none": np.zeros((0, 3))}, do_compression=compressed
    )
    theirs = scipy.io.loadmat(path)
    ours = read_variables(path, [*TYPES, "inner", "none"])
    for name in TYPES:
        assert np.array_equal(ours[name], theirs[name]) and ours[name].dtype == np.dtype(name)
    assert ours["none"].shape == (0, 3)
    assert ours["inner"]["text"] == "night" and ours["inner"]["n"] == 7
    first, text, nested = ours["inner"]["cell"]
    assert np.array_equal(first, arrays["f4"]) and text == "b"
    assert [float(v[0, 0]) for v in nested] == [1.0, 2.0]
    assert read_variables(path, ["f4"]).keys() == {"f4"}


def test_big_endian_files_are_read(tmp_path):
    """One variable x = [1 2] of doubles, written by hand."""
    dims, name = struct.pack(">IIii", 5, 8, 1, 2), struct.pack(">HH4s", 1, 1, b"x\0\0\0")
    numbers = struct.pack(">IIdd", 9, 16, 1.0, 2.0)
    body = struct.pack(">IIII", 6, 8, 6, 0) + dims + name + numbers
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(">H", 0x0100) + b"MI"
    (tmp_path / "a.mat").write_bytes(head + struct.pack(">II", 14, len(body)) + body)
    assert np.array_equal(read_variables(tmp_path / "a.mat", ["x"])["x"], [[1.0, 2.0]])


def test_a_matlab_object_is_left_out_and_said(tmp_path):
    """NetVLAD's own file has its VLAD layer as an object; here the class of a number is changed."""
    path = matconvnet(tmp_path, random_layers())
    top = scipy.io.loadmat(path)
    every = [*top["layers"].ravel(), np.full((3, 5), 7.0)]
    top = {"layers": cell(every), "meta": top["meta"]}
    scipy.io.savemat(path, {"net": top})
    data = path.read_bytes()
    number = struct.pack("<IIIIIIii", 6, 8, 6, 0, 5, 8, 3, 5)
    assert data.count(number) == 1
    opaque = struct.pack("<IIIIIIii", 6, 8, 17, 0, 5, 8, 3, 5)
    path.write_bytes(data.replace(number, opaque))
    source = read_source(path, shapes=SMALL)
    assert source.family == "netvlad" and source.extras == {}
    assert "without NetVLAD's head" in source.notes[0]


def test_cells_without_end_are_refused(tmp_path):
    value: object = 1.0
    for _ in range(MAX_DEPTH + 2):
        value = cell([value])
    scipy.io.savemat(tmp_path / "a.mat", {"x": value})
    with pytest.raises(ValueError, match="more than 16 times"):
        read_variables(tmp_path / "a.mat", ["x"])


def test_a_cell_of_more_elements_than_the_file_has_is_refused_at_once(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"x": cell([1.0, 2.0])})
    data = path.read_bytes()
    dims = struct.pack("<IIii", 5, 8, 1, 2)
    path.write_bytes(data.replace(dims, struct.pack("<IIii", 5, 8, 1 << 30, 1 << 30), 1))
    with pytest.raises(ValueError, match="too few elements"):
        read_variables(path, ["x"])


def test_a_variable_that_unpacks_without_end_is_refused(tmp_path, monkeypatch):
    from jaxsfm.weights_conversion import mat5

    monkeypatch.setattr(mat5, "MAX_VARIABLE", 1000)
    scipy.io.savemat(tmp_path / "a.mat", {"x": np.zeros(10_000)}, do_compression=True)
    with pytest.raises(ValueError, match="more than 1000 bytes"):
        read_variables(tmp_path / "a.mat", ["x"])
