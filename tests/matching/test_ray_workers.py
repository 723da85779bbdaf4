"""Workers on Ray: every item once, whatever becomes of them, and little at a time."""

import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from jaxsfm.cli.main import main
from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.matching import ray_workers
from jaxsfm.matching.ray_cluster import connect, xla_threads
from jaxsfm.matching.ray_workers import MAX_LOSSES, TASKS_PER_WORKER, Task, worker_pool

# Not importorskip: it would import Ray before we have told it to be quiet.
pytestmark = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
WORKERS = 2


@pytest.fixture(scope="module")
def cluster() -> Iterator:
    """Ray on this machine, for all tests here."""
    with connect("local") as ray:
        ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
        yield ray


def echo(items, objects):
    for item in items:
        time.sleep(0.01)
        yield item, objects[f"of {item}"]


class DiesOnce:
    """Its process is killed at one item, the first time: there is no file yet."""

    def __init__(self, item: int, note: Path) -> None:
        self.item, self.note = item, note

    def __call__(self, items, objects):
        for item in items:
            if item == self.item and not self.note.exists():
                self.note.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            yield item, objects[f"of {item}"]


def dies(items, objects):
    if 5 in items:
        os.kill(os.getpid(), signal.SIGKILL)
    yield from echo(items, objects)


class Fails:
    def __init__(self, error: Exception) -> None:
        self.error = error

    def __call__(self, items, objects):
        raise self.error
        yield


def threads_there(items, objects):
    for item in items:
        yield item, os.environ["NPROC"]


def pieces(workers, count: int, size: int = 3) -> Iterator[Task]:
    for start in range(0, count, size):
        items = range(start, min(count, start + size))
        yield Task(list(items), {f"of {k}": workers.put(k * k) for k in items})


def noted(all_pieces: Iterator[Task], given: list) -> Iterator[Task]:
    for piece in all_pieces:
        given.append(piece)
        yield piece


SQUARES = [(k, k * k) for k in range(40)]


def results(work, count: int = 40, number: int = WORKERS) -> list:
    with worker_pool(work, address=None, workers=number) as workers:
        return sorted(workers.results(pieces(workers, count)))


@pytest.mark.slow
def test_every_item_has_its_result_once(cluster):
    assert results(echo) == SQUARES


@pytest.mark.parametrize(("number", "item"), [(WORKERS, 19), (1, 39)], ids=["two", "last of one"])
@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_every_item_still_comes_once(
    cluster, tmp_path, number, item
):
    assert results(DiesOnce(item, tmp_path / "note"), number=number) == SQUARES
    assert (tmp_path / "note").exists()


@pytest.mark.slow
def test_workers_compute_with_as_many_threads_as_this_process(cluster, monkeypatch):
    """With one thread instead of two, features differ in their last place."""
    assert set(results(threads_there, 3)) == {(k, str(xla_threads())) for k in range(3)}
    monkeypatch.setenv("NPROC", "7")
    assert set(results(threads_there, 3)) == {(k, "7") for k in range(3)}


@pytest.mark.slow
def test_few_pieces_are_out_at_a_time(cluster):
    """However many there are: those at the workers, and none before the first worker is there."""
    come, most = [], 0
    with worker_pool(echo, address=None, workers=WORKERS) as workers:
        given = []
        for result in workers.results(noted(pieces(workers, 40, size=1), given)):
            most = max(most, len(given) - len(come))
            come.append(result)
    assert sorted(come) == SQUARES and 2 <= most <= TASKS_PER_WORKER * WORKERS


@pytest.mark.slow
def test_an_item_that_kills_its_workers_ends_the_run_with_a_sentence(cluster):
    come = []
    with (
        pytest.raises(UserError, match=f"{MAX_LOSSES + 1} times"),
        worker_pool(dies, address=None, workers=WORKERS) as workers,
    ):
        come.extend(workers.results(pieces(workers, 12)))


@pytest.mark.parametrize("error", [UserError("photo 3 is too large"), MemoryError("no room")])
@pytest.mark.slow
def test_an_error_in_a_worker_is_the_same_error_here(cluster, error):
    with pytest.raises(type(error), match=f"^{error}$"):
        results(Fails(error))


@pytest.mark.slow
def test_what_has_come_is_handed_out_before_an_interrupt(cluster):
    come, given = [], []
    with worker_pool(echo, address=None, workers=WORKERS) as workers:
        stream = workers.results(noted(pieces(workers, 40), given))
        come.append(next(stream))
        time.sleep(1)  # in which the workers do all that they have
        interrupt._pending.set()
        with pytest.raises(KeyboardInterrupt):
            come.extend(stream)
    assert len(given) <= TASKS_PER_WORKER * WORKERS
    assert sorted(k for k, _ in come) == sorted(k for piece in given for k in piece.items)


@pytest.mark.slow
def test_workers_with_other_packages_are_refused(cluster, monkeypatch):
    ours = ray_workers.package_versions() | {"jaxsfm": "9.9"}
    monkeypatch.setattr(ray_workers, "package_versions", lambda: ours)
    with pytest.raises(UserError, match=r"worker has jaxsfm \d.*, this process 9\.9: install"):
        results(echo)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--workers", "2"], "--workers is for --engine ray"),
        (["--engine", "ray", "--workers", "0"], "--workers must be at least 1"),
        (["--engine", "ray", "--workers", "999"], "--workers 999: there are"),
        (["--engine", "ray"], r"pip install 'jaxsfm\[ray\]'"),
    ],
    ids=["local", "none", "too many", "no Ray"],
)
def test_what_cannot_be_is_one_sentence(
    cluster, scene, tmp_path, monkeypatch, capsys, options, why
):
    if "--workers" not in options:
        monkeypatch.setitem(sys.modules, "ray", None)
    out = str(tmp_path / "out")
    assert main(["reconstruct", str(scene / "images"), "--out", out, *options]) == 2
    error = capsys.readouterr().err
    assert re.search(why, error) and "Traceback" not in error
