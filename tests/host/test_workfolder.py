"""A run's folder: whole files or none, bit for bit."""

import os

import numpy as np
import pytest

from jaxsfm.core.types import DenseFeatures, Status
from jaxsfm.errors import UserError
from jaxsfm.host.features import ImageFeatures
from jaxsfm.host.images import ImageFile
from jaxsfm.host.pairs import PairResult
from jaxsfm.host.workfolder import SavedMatches, WorkFolder


def features(name: str = "a.jpg", digit: str = "a") -> ImageFeatures:
    rng = np.random.default_rng(ord(digit))
    dense = DenseFeatures(
        tuple(rng.normal(size=(n, 8)).astype(np.float16) for n in (4, 1)),
        tuple(rng.normal(size=(n, 4)).astype(np.float16) for n in (16, 4)),
        rng.normal(size=(16, 2)).astype(np.float32),
        np.asarray([2, 2], np.int32),
        np.asarray([4, 4], np.int32),
    )
    image = ImageFile(name=name, path=name, size=(64, 64), sha256=64 * digit)
    return ImageFeatures(image, (1 / 3, 2.5), dense)


def result(pair=("a.jpg", "b.jpg"), n: int = 5) -> PairResult:
    rng = np.random.default_rng(n)
    return PairResult(
        pair=pair,
        cells=rng.integers(0, 99, (n, 2)).astype(np.int32),
        keypoints0=rng.normal(size=(n, 2)).astype(np.float32),
        keypoints1=rng.normal(size=(n, 2)).astype(np.float32),
        plane=np.zeros(n, np.int32),
        homographies=rng.normal(size=(2, 3, 3)),
        num_tentative=77,
        num_dropped=3,
        status=Status.NO_PLANE,
    )


def assert_same(got, want) -> None:
    """Equal field by field, arrays to the bit."""
    for key, value in (want._asdict() if hasattr(want, "_asdict") else vars(want)).items():
        other = getattr(got, key)
        if isinstance(value, tuple) and value and isinstance(value[0], np.ndarray):
            pairs = list(zip(other, value, strict=True))
        else:
            pairs = [(other, value)]
        for one, wanted in pairs:
            if isinstance(wanted, np.ndarray):
                assert (one.dtype, one.shape) == (wanted.dtype, wanted.shape), key
                assert one.tobytes() == wanted.tobytes(), key
        if isinstance(pairs[0][1], np.ndarray):
            continue
        if not isinstance(value, DenseFeatures):
            assert other == value and type(other) is type(value), key


@pytest.mark.parametrize("n", [0, 5])
def test_matches_come_back_bit_for_bit(tmp_path, n):
    folder = WorkFolder(tmp_path)
    pairs = [("a.jpg", "b.jpg"), ("a b", "c"), ("a", "b c"), ("new\nline", "日本"), ("x", "\udcff")]
    for i, pair in enumerate(pairs):
        folder.save_matches(result(pair, n + i))
    for i, pair in enumerate(pairs):
        assert_same(WorkFolder(tmp_path).load_matches(pair), result(pair, n + i))
    assert folder.load_matches(("b.jpg", "a.jpg")) is None


def test_features_come_back_bit_for_bit(tmp_path):
    saved = features()
    assert not WorkFolder(tmp_path).has_features(saved.image)
    WorkFolder(tmp_path).save_features(saved)
    fresh = WorkFolder(tmp_path)
    assert fresh.has_features(saved.image)
    loaded = fresh.load_features(saved.image)
    assert_same(loaded, saved)
    assert_same(loaded.dense, saved.dense)


def test_features_follow_the_content_not_the_name(tmp_path):
    WorkFolder(tmp_path).save_features(features("a.jpg", "a"))
    assert WorkFolder(tmp_path).load_features(features("renamed.jpg", "a").image) is not None
    assert WorkFolder(tmp_path).load_features(features("a.jpg", "b").image) is None


def only_file(folder):
    (file,) = (path for path in folder.rglob("*") if path.is_file())
    return file


def damages(data: bytes):
    yield from (b"", b"text", data[:10], data[: len(data) // 2], data[:-1])
    yield data[:200] + bytes([data[200] ^ 255]) + data[201:]
    entry = data.index(b"PK\x01\x02")  # the first line of the zip's directory
    for offset in (8, 10, 16):  # flags, method, checksum
        yield data[: entry + offset] + b"\xff" + data[entry + offset + 1 :]


@pytest.mark.parametrize("case", range(9))
def test_a_damaged_file_reads_as_none(tmp_path, case):
    """Including what zipfile calls NotImplementedError or RuntimeError."""
    WorkFolder(tmp_path / "m").path.mkdir()
    WorkFolder(tmp_path / "m").save_matches(result())
    WorkFolder(tmp_path / "f").path.mkdir()
    WorkFolder(tmp_path / "f").save_features(features())
    for sub in ("m", "f"):
        file = only_file(tmp_path / sub)
        file.write_bytes(list(damages(file.read_bytes()))[case])
    assert WorkFolder(tmp_path / "m").load_matches(result().pair) is None
    assert WorkFolder(tmp_path / "f").load_features(features().image) is None


def test_a_file_cut_anywhere_reads_as_none(tmp_path):
    WorkFolder(tmp_path).save_matches(result())
    file = only_file(tmp_path)
    data = file.read_bytes()
    for length in range(0, len(data), 97):
        file.write_bytes(data[:length])
        assert WorkFolder(tmp_path).load_matches(result().pair) is None


def test_an_interrupted_write_leaves_nothing_that_is_read(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    folder = WorkFolder(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", interrupted)
        for save, value in ((folder.save_matches, result()), (folder.save_features, features())):
            with pytest.raises(KeyboardInterrupt):
                save(value)
    partial = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(partial) == 2 and all(path.suffix == ".partial" for path in partial)
    assert folder.load_matches(result().pair) is None
    assert not folder.has_features(features().image)
    assert folder.load_features(features().image) is None
    folder.save_matches(result())  # and it does not stand in the way
    assert_same(folder.load_matches(result().pair), result())


def test_dropping_features_keeps_matches(tmp_path):
    folder = WorkFolder(tmp_path)
    folder.save_features(features())
    folder.save_matches(result())
    folder.drop_features()
    assert not (tmp_path / "features").exists() and not folder.has_features(features().image)
    assert_same(folder.load_matches(result().pair), result())
    folder.drop_features()  # again: nothing to drop


def test_saved_matches_are_read_when_asked_for(tmp_path):
    folder = WorkFolder(tmp_path)
    pairs = [("a.jpg", "b.jpg"), ("a.jpg", "c.jpg")]
    for n, pair in enumerate(pairs, start=3):
        folder.save_matches(result(pair, n))
    saved = SavedMatches(folder, pairs)
    assert list(saved) == pairs and len(saved) == 2
    assert_same(saved[pairs[1]], result(pairs[1], 4))
    assert ("b.jpg", "c.jpg") not in saved and saved.get(("b.jpg", "c.jpg")) is None
    folder.save_matches(result(("b.jpg", "c.jpg")))  # another run's, or not handed on
    assert ("b.jpg", "c.jpg") not in saved
    for path in (tmp_path / "matches").iterdir():
        path.write_bytes(b"")
    with pytest.raises(UserError, match="a.jpg.*damaged"):
        saved[pairs[0]]


def test_counts_say_what_a_result_holds():
    counts = result(n=5).counts
    assert (counts.num_inliers, counts.num_planes, counts.num_tentative) == (5, 2, 77)
    assert (counts.num_dropped, counts.status) == (3, Status.NO_PLANE)
