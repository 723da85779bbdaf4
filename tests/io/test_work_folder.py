"""What a run stores is found again bit for bit, as long as nothing it depends on has changed."""

import os

import numpy as np
import pytest

from jaxsfm.core.types import DenseFeatures, Status
from jaxsfm.errors import UserError
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import DamagedImage, ImageFile
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.store import SavedMatches, Store

PAIRS = [("a.jpg", "b.jpg"), ("a b", "c"), ("a", "b c"), ("new\nline", "日本"), ("x", "\udcff")]
CONFIG = {"octaves": 2, "threshold_px": 10.0}
IDENTITY = {
    "version": "1",
    "weights": "w",
    "relocalizer": None,
    "config": CONFIG,
    "seed": 0,
    "images": {name: f"hash of {name!r}" for name in ("c.jpg", *(n for p in PAIRS for n in p))},
}


def opened(path, **changes) -> Store:
    return Store(path, IDENTITY | changes)


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
        cells=np.stack([rng.permutation(99)[:n] for _ in range(2)], axis=1).astype(np.int32),
        keypoints0=rng.normal(size=(n, 2)).astype(np.float32),
        keypoints1=rng.normal(size=(n, 2)).astype(np.float32),
        plane=np.zeros(n, np.int32),
        homographies=rng.normal(size=(2, 3, 3)),
        num_tentative=77,
        num_dropped=3,
        status=Status.NO_PLANE,
    )


def assert_same(got, want) -> None:
    """Whether all fields are equal, and arrays equal bit for bit."""
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
    folder = opened(tmp_path)
    for i, pair in enumerate(PAIRS):
        folder.save_matches(result(pair, n + i))
    for i, pair in enumerate(PAIRS):
        assert_same(opened(tmp_path).load_matches(pair), result(pair, n + i))
    assert folder.load_matches(("b.jpg", "a.jpg")) is None


def test_features_come_back_bit_for_bit(tmp_path):
    saved = features()
    assert not opened(tmp_path).has_features(saved.image)
    opened(tmp_path).save_features(saved)
    fresh = opened(tmp_path)
    assert fresh.has_features(saved.image)
    loaded = fresh.load_features(saved.image)
    assert_same(loaded, saved)
    assert_same(loaded.dense, saved.dense)


def test_features_follow_the_content_not_the_name(tmp_path):
    opened(tmp_path).save_features(features("a.jpg", "a"))
    assert opened(tmp_path).load_features(features("renamed.jpg", "a").image) is not None
    assert opened(tmp_path).load_features(features("a.jpg", "b").image) is None


def only_file(folder):
    (file,) = (path for path in folder.rglob("*") if path.is_file())
    return file


def damages(data: bytes):
    yield from (b"", b"text", data[:10], data[: len(data) // 2], data[:-1], data + b"0")
    body = 8 + int.from_bytes(data[:8], "little")  # the header's length comes first
    for at in (0, 20, body, body + 40, len(data) - 1):
        yield data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]
    dtype = data.index(b'"I32"') if b'"I32"' in data else data.index(b'"F32"')
    yield data[:dtype] + b'"U32"' + data[dtype + 5 :]  # the same bytes as other numbers


@pytest.mark.parametrize("case", range(12))
def test_a_damaged_file_reads_as_none(tmp_path, case):
    opened(tmp_path / "m").save_matches(result())
    opened(tmp_path / "f").save_features(features())
    for sub in ("m", "f"):
        file = only_file(tmp_path / sub)
        file.write_bytes(list(damages(file.read_bytes()))[case])
    assert opened(tmp_path / "m").load_matches(result().pair) is None
    assert opened(tmp_path / "f").load_features(features().image) is None


def test_a_file_cut_anywhere_reads_as_none(tmp_path):
    opened(tmp_path).save_matches(result())
    file = only_file(tmp_path)
    data = file.read_bytes()
    for length in range(0, len(data), 97):
        file.write_bytes(data[:length])
        assert opened(tmp_path).load_matches(result().pair) is None


def test_an_interrupted_write_leaves_nothing_that_is_read(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    folder = opened(tmp_path)
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
    folder.save_matches(result())  # nor does it prevent saving
    assert_same(folder.load_matches(result().pair), result())


def test_dropping_features_keeps_matches(tmp_path):
    folder = opened(tmp_path)
    folder.save_features(features())
    folder.save_matches(result())
    folder.drop_features()
    assert not (tmp_path / "features").exists() and not folder.has_features(features().image)
    assert_same(folder.load_matches(result().pair), result())
    folder.drop_features()  # again: nothing to drop


def test_saved_matches_are_read_when_asked_for(tmp_path):
    folder = opened(tmp_path)
    pairs = [("a.jpg", "b.jpg"), ("a.jpg", "c.jpg")]
    for n, pair in enumerate(pairs, start=3):
        folder.save_matches(result(pair, n))
    saved = SavedMatches(folder, pairs)
    assert list(saved) == pairs and len(saved) == 2
    assert_same(saved[pairs[1]], result(pairs[1], 4))
    assert ("b.jpg", "c.jpg") not in saved and saved.get(("b.jpg", "c.jpg")) is None
    folder.save_matches(result(("b.jpg", "c.jpg")))  # a pair that was not chosen
    assert ("b.jpg", "c.jpg") not in saved
    for path in (tmp_path / "matches").rglob("*.safetensors"):
        path.write_bytes(b"")
    with pytest.raises(UserError, match="a.jpg.*damaged"):
        saved[pairs[0]]


def test_counts_say_what_a_result_holds():
    counts = result(n=5).counts
    assert (counts.num_inliers, counts.num_planes, counts.num_tentative) == (5, 2, 77)
    assert (counts.num_dropped, counts.status) == (3, Status.NO_PLANE)


def test_everything_is_kept_under_all_that_it_depends_on(tmp_path):
    """What does not depend on a change is found again."""
    store = opened(tmp_path)
    store.save_features(features())
    store.save_matches(result())
    store.save_descriptor(features().image, "kind", np.ones(3))
    store.record_failure(features(digit="b").image, DamagedImage("torn"))
    other = {"images": IDENTITY["images"] | {"b.jpg": "other"}}
    fewer = {"images": {name: IDENTITY["images"][name] for name in ("a.jpg", "b.jpg")}}
    cases = [  # change, features, matches, descriptor, unusable
        ({}, True, True, True, True),
        ({"version": "2"}, False, False, False, False),
        ({"weights": "v"}, False, False, False, True),
        ({"relocalizer": "r"}, False, False, False, True),
        ({"config": CONFIG | {"octaves": 1}}, False, False, True, True),
        ({"config": CONFIG | {"threshold_px": 5.0}}, True, False, True, True),
        ({"seed": 1}, True, False, True, True),
        (other, True, False, True, True),
        (fewer, True, True, True, True),
    ]
    for change, *expected in cases:
        now = opened(tmp_path, **change)
        image = features().image
        found = [
            now.load_features(image) is not None,
            now.load_matches(result().pair) is not None,
            now.load_descriptor(image, "kind") is not None,
            now.why_unusable(features(digit="b").image) is not None,
        ]
        assert found == expected, change
    assert store.load_descriptor(features().image, "other kind") is None
    assert store.load_descriptor(features(digit="b").image, "kind") is None


def test_matches_follow_the_contents_not_the_names(tmp_path):
    opened(tmp_path).save_matches(result())
    renamed = {"images": {"y.jpg": IDENTITY["images"]["a.jpg"], "z.jpg": "hash of 'b.jpg'"}}
    found = opened(tmp_path, **renamed).load_matches(("y.jpg", "z.jpg"))
    assert found is not None and found.pair == ("y.jpg", "z.jpg")
    assert_same(found, result(("y.jpg", "z.jpg")))
    assert opened(tmp_path, **renamed).load_matches(("z.jpg", "y.jpg")) is None


def test_sweeping_removes_what_was_half_written_alone(tmp_path):
    store = opened(tmp_path)
    store.save_matches(result())
    file = only_file(tmp_path)
    file.with_name(file.name + ".partial").write_bytes(b"half")
    (tmp_path / "failed").mkdir()
    for name in (
        "report.json.17.partial",
        "report.html.17.partial",
        "failed/report.html.9.partial",
    ):
        (tmp_path / name).write_bytes(b"half")
    store.sweep()
    assert only_file(tmp_path) == file
