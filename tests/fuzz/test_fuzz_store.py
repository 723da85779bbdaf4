"""Damaged files of a work folder: the right content, or none; never code that runs."""

import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from fuzz_children import run_cases
from mutations import damaged, damaged_json, outcome

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import write_database
from jaxsfm.core.types import DenseFeatures, Status
from jaxsfm.io.atomic import load_arrays, save_arrays
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.store import Store
from jaxsfm.io.work_folder import open_folder

PAIR = ("a.jpg", "b.jpg")
FILES = [
    ImageFile(name=n, path=n, size=(64, 64), sha256=64 * n[0])  # type: ignore[arg-type]
    for n in PAIR
]
IDENTITY = {
    "version": "1",
    "weights": "w",
    "relocalizer": None,
    "config": {"octaves": 2},
    "seed": 0,
    "images": {file.name: file.sha256 for file in FILES},
}


def features() -> ImageFeatures:
    rng = np.random.default_rng(0)
    dense = DenseFeatures(
        tuple(rng.normal(size=(n, 8)).astype(np.float16) for n in (16, 4)),
        tuple(rng.normal(size=(n, 4)).astype(np.float16) for n in (64, 16)),
        rng.uniform(0, 64, (64, 2)).astype(np.float32),
        np.asarray([4, 4], np.int32),
        np.asarray([8, 8], np.int32),
    )
    return ImageFeatures(FILES[0], (1.0, 2.5), dense)


def matches(n: int = 20) -> PairResult:
    rng = np.random.default_rng(1)
    return PairResult(
        pair=PAIR,
        cells=np.stack([rng.permutation(n), rng.permutation(n)], 1).astype(np.int32),
        keypoints0=rng.uniform(0, 64, (n, 2)).astype(np.float32),
        keypoints1=rng.uniform(0, 64, (n, 2)).astype(np.float32),
        plane=rng.integers(0, 2, n).astype(np.int32),
        homographies=rng.normal(size=(2, 3, 3)),
        num_tentative=77,
        num_dropped=0,
        status=Status.VERIFIED,
    )


def saved(folder, what: str):
    """A store with one file, its path, and how it is read."""
    store = Store(folder, IDENTITY)
    if what == "features":
        store.save_features(features())
        return store._feature_path(FILES[0]), lambda: store.load_features(FILES[0])
    store.save_matches(matches())
    return store._match_path(PAIR), lambda: store.load_matches(PAIR)


def same(a, b) -> bool:
    """Equal, arrays to the bit."""
    if isinstance(b, np.ndarray):
        return (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    if hasattr(b, "_asdict") or isinstance(b, PairResult):
        return all(same(getattr(a, name), value) for name, value in fields(b).items())
    if isinstance(b, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


def fields(value) -> dict:
    return value._asdict() if hasattr(value, "_asdict") else vars(value)


def file_bytes(rng, folder) -> str:
    """Any damage to the file: its checksums find it, or it did not touch the content."""
    what = ["features", "matches"][rng.integers(2)]
    path, load = saved(folder, what)
    path.write_bytes(damaged(path.read_bytes(), rng))
    found = load()
    assert found is None or same(found, features() if what == "features" else matches())
    return "none" if found is None else "same"


def changed(array: np.ndarray, rng) -> np.ndarray:
    """Of another type or shape, or with a value that no run writes."""
    kind = rng.integers(6)
    if kind == 0:
        return array.astype([np.float64, np.int8, np.uint16, np.bool_, np.int16][rng.integers(5)])
    if kind == 1:
        return array[rng.integers(len(array) + 1) :]
    if kind == 2:
        return array.reshape(-1)
    if kind == 3:
        return array[..., None]
    if kind == 4:
        return np.zeros((), array.dtype)
    array = array.copy()
    worst = [-1, 2**31 - 1, -(2**31)] if array.dtype.kind == "i" else [np.nan, np.inf, -np.inf]
    array.flat[rng.integers(array.size)] = worst[rng.integers(3)]
    return array


def arrays(rng, folder) -> str:
    """Whole files of wrong arrays: what is read at all is what COLMAP and the programs take."""
    what = ["features", "matches"][rng.integers(2)]
    path, load = saved(folder, what)
    content = load_arrays(path)
    names = sorted(content)
    name = names[rng.integers(len(names))]
    if rng.random() < 0.15:
        del content[name]
    else:
        content[name] = changed(content[name], rng)
    save_arrays(path, content)
    found = load()
    if found is None:
        return "none"
    if what == "features":
        assert (
            found.capacity.num_coarse
            == len(found.dense.coarse[0])
            >= found.dense.coarse_grid.prod()
        )
        assert np.isfinite(found.dense.keypoints).all()
    else:
        names = dict(zip(PAIR, FILES, strict=True))
        write_database(folder / "d.db", list(names.values()), {PAIR: found}, Cameras())
    return "read"


def record(rng, folder) -> str:
    """run.json, what could not be used and what was being published."""
    out = folder / "out"
    out.mkdir(exist_ok=True)
    whole = {
        "run.json": IDENTITY,
        "unusable.json": {"1" * 32: "photo.jpg: damaged", "2" * 32: "b"},
        "publishing/moves.json": {"failed": False, "names": ["report.json", "sparse"]},
    }
    (out / "publishing").mkdir(exist_ok=True)
    name = [*whole][rng.integers(len(whole))]
    for each, content in whole.items():
        data = damaged_json(content, rng) if each == name else json.dumps(content).encode()
        (out / each).write_bytes(data)

    def read():
        with open_folder(out, IDENTITY) as store:
            return store.why_unusable(FILES[0]), (out / "publishing").exists()

    how, found = outcome(read, "--out")
    assert how == "refused" or found == (None, False)
    return how


def stage(rng, folder) -> str:
    """A stage's files: they are used as they were made, or made again."""

    def write(fresh: Path) -> None:
        (fresh / "sparse").mkdir()
        (fresh / "sparse" / "points3D.bin").write_bytes(b"points" * 20)
        (fresh / "figures.json").write_text("[1, 2, 3]")

    with open_folder(folder / "out", IDENTITY) as store:
        made = store.stage("mapped", "key", write)
        files = sorted(path for path in made.rglob("*") if path.is_file())
        path = files[rng.integers(len(files))]
        before = path.read_bytes()
        path.write_bytes(damaged(before, rng))
        again = []
        store.stage("mapped", "key", again.append)
        assert again or path.read_bytes() == before
    return "none" if again else "same"


@pytest.mark.parametrize("kind, count", [("file_bytes", 500), ("arrays", 300)])
def test_damaged_features_and_matches_are_none_or_right(tmp_path, share, least, kind, count):
    found = run_cases("test_fuzz_store", kind, round(count * share), tmp_path)
    assert found["none"] > least * count / 2 and found.total() == round(share * count)


def test_damaged_records_of_a_folder_are_ignored_or_refused(tmp_path, share, least):
    found = run_cases("test_fuzz_store", "record", round(300 * share), tmp_path)
    assert found["read"] > 50 * least and found["refused"] > 20 * least


def test_a_damaged_stage_is_made_again(tmp_path, share, least):
    found = run_cases("test_fuzz_store", "stage", round(100 * share), tmp_path)
    assert found["none"] > 90 * least


class _Attack:
    def __init__(self, proof):
        self.proof = proof

    def __reduce__(self):
        return os.system, (f"touch {self.proof}",)


@pytest.mark.parametrize("what", ["features", "matches"])
def test_a_pickled_object_in_a_file_is_never_loaded(tmp_path, what):
    path, load = saved(tmp_path, what)
    proof = tmp_path / "executed"
    attack = [_Attack(proof)]
    path.write_bytes(pickle.dumps(attack[0]))  # numpy takes such a file for a pickle
    assert load() is None and not proof.exists()
    pickle.loads(pickle.dumps(attack[0]))  # the attack is real
    assert proof.exists()


def test_no_more_memory_is_taken_than_the_file_is_long(tmp_path):
    """A header that claims more than is there, with a length that is right or wrong."""
    path, load = saved(tmp_path, "matches")
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    for name in header.keys() - {"crc32"}:
        claimed = {
            **header,
            name: {**header[name], "shape": [1 << 40], "data_offsets": [0, 1 << 42]},
        }
        text = json.dumps(claimed).encode()
        path.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + length :])
        assert load() is None
    path.write_bytes((1 << 40).to_bytes(8, "little") + data[8:])
    assert load() is None
