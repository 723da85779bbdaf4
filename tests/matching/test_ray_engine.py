"""Extraction and matching on Ray: what the local engine gives, with little held at a time."""

import contextlib
import itertools
import os
import shutil
import signal
import threading
import time
import weakref
from collections import deque
from importlib.util import find_spec
from pathlib import Path

import pytest
from databases import content
from hypothesis import given
from hypothesis import strategies as st

from jaxsfm import preset
from jaxsfm.cli.main import main
from jaxsfm.io.pairs import exhaustive_pairs
from jaxsfm.io.store import Store
from jaxsfm.matching import engines
from jaxsfm.matching.engines import CACHED_IMAGES, TILE, RayEngine, pair_blocks
from jaxsfm.matching.ray_workers import TASKS_PER_WORKER

# Not importorskip: it would import Ray before we have told it to be quiet.
pytestmark = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")


def busy_worker() -> int | None:
    """A process that runs a worker's task for this process's Ray: its parent is our child."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if b"ray::_Worker.run" in (folder / "cmdline").read_bytes():
                parent = folder
                for _ in range(2):
                    number = (parent / "stat").read_text().rpartition(")")[2].split()[1]
                    parent = Path("/proc") / number
                if int(parent.name) == os.getpid():
                    return int(folder.name)
    return None


def kill_a_busy_worker(killed: list[int]) -> None:
    deadline = time.monotonic() + 60
    while not killed and time.monotonic() < deadline:
        if pid := busy_worker():
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)
        time.sleep(0.02)


@pytest.mark.slow
def test_a_killed_worker_and_a_damaged_photo_change_nothing(scene, tmp_path, monkeypatch, capsys):
    """SIGKILL while it matches; the damaged photo is found by a worker."""
    photos = tmp_path / "photos"
    shutil.copytree(scene / "images", photos)
    (photos / "torn.png").write_bytes((photos / "view0.png").read_bytes()[:20_000])
    args = ["reconstruct", str(photos), "--preset", "paper", "--threads", "1", "--out"]
    assert main([*args, str(tmp_path / "local")]) == 0
    original, killed = Store.load_features, []
    killer = threading.Thread(target=kill_a_busy_worker, args=(killed,))

    def loading(self, image):  # features are wanted as soon as the first worker is there
        if killer.ident is None:
            killer.start()
        return original(self, image)

    monkeypatch.setattr(Store, "load_features", loading)
    capsys.readouterr()
    assert main([*args, str(tmp_path / "ray"), "--engine", "ray", "--workers", "2"]) == 0
    printed = capsys.readouterr()
    assert killed and "Ray lost a worker, another is started" in printed.err
    assert "raylet" not in printed.out + printed.err
    local, ray = (tmp_path / run for run in ("local", "ray"))
    files = sorted(str(path.relative_to(local)) for path in local.glob("matches/**/*.safetensors"))
    assert len(files) == 3 == len(list(ray.glob("matches/**/*.safetensors")))
    for name in (*files, "sparse/0/points3D.bin", "unusable.json"):
        assert (local / name).read_bytes() == (ray / name).read_bytes(), name
    assert content(local / "database.db") == content(ray / "database.db")


@given(
    st.lists(st.tuples(st.integers(0, 60), st.integers(0, 60)), unique=True, max_size=300),
    st.integers(1, TILE * TILE),
)
def test_blocks_are_the_pairs_cut_small(numbers, size):
    pairs = [(str(a), str(b)) for a, b in numbers]
    blocks = pair_blocks(pairs, size)
    assert sorted(itertools.chain(*blocks)) == sorted(pairs)
    for block in blocks:
        assert 1 <= len(block) <= size
        assert len({name for pair in block for name in pair}) <= 2 * TILE


class Held:
    """What stands for an image's features, or for a reference to them."""


class OtherPool:
    """Two workers in this process that end their pieces in another order than they got them."""

    def __init__(self) -> None:
        self.alive: weakref.WeakSet[Held] = weakref.WeakSet()
        self.most = 0

    def __len__(self) -> int:
        return 2

    def put(self, value: Held) -> Held:
        self.alive.add(reference := Held())
        self.most = max(self.most, len(self.alive))
        return reference

    def results(self, pieces):
        todo, given = iter(pieces), deque()
        while True:
            given.extend(itertools.islice(todo, TASKS_PER_WORKER * len(self) - len(given)))
            if not given:
                return
            given.rotate(1)
            for pair in given.popleft().items:
                yield pair, pair


@pytest.mark.parametrize("images", [20, 100, 200])
def test_features_held_do_not_grow_with_the_pairs(images, monkeypatch):
    pool = OtherPool()
    monkeypatch.setattr(engines, "worker_pool", lambda *_, **__: contextlib.nullcontext(pool))
    pairs = exhaustive_pairs(f"{k:03}" for k in range(images))
    loads = []

    def load(name: str) -> Held:
        loads.append(name)
        return Held()

    found = RayEngine().match_pairs(load, {}, pairs, config=preset("default"))
    assert sorted(found) == pairs
    # Of the pieces at the workers, of the next one, and those kept for pieces to come.
    assert pool.most <= (TASKS_PER_WORKER * len(pool) + 1) * 2 * TILE + CACHED_IMAGES
    assert len(loads) <= 2 * len(pairs) / TILE + images
