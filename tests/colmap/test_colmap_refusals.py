"""What the adapter to COLMAP refuses, and how it waits for native code."""

import dataclasses
import threading

import numpy as np
import pycolmap
import pytest
from mapped import map_database

from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.native import THREAD

ONE = MapOptions(refine_intrinsics=False, threads=1)


# -- bad input -------------------------------------------------------------------------------------


def changed(name: str, edit):
    """The first pair's result with a copy of one array edited."""

    def apply(results: dict) -> dict:
        pair = next(iter(results))
        array = getattr(results[pair], name).copy()
        return {**results, pair: dataclasses.replace(results[pair], **{name: edit(array)})}

    return apply


def put(index, value):
    def edit(array):
        array[index] = value
        return array

    return edit


def renamed(results: dict) -> dict:
    first = next(iter(results.values()))
    pair = (first.pair[0], "unknown.png")
    return {pair: dataclasses.replace(first, pair=pair)}


def swapped_key(results: dict) -> dict:
    """A key that is not the result's pair: its indices belong to other images."""
    first, second, *_ = results
    return {second: results[first]}


BAD = {
    "nan": (changed("keypoints0", put((3, 1), np.nan)), "must be finite"),
    "infinite": (changed("keypoints1", put((0, 0), np.inf)), "must be finite"),
    "left": (changed("keypoints0", put((0, 0), -0.6)), "outside the image"),
    "below": (changed("keypoints1", put((0, 1), 768)), "outside the image"),
    "twice 0": (changed("cells", put((0, 0), 2)), "matched twice"),
    "twice 1": (changed("cells", put((0, 1), 2)), "matched twice"),
    "unknown": (renamed, "not given: 'unknown.png'"),
    "other key": (swapped_key, "pair"),
    "too few keypoints": (changed("keypoints0", lambda a: a[:-1]), "keypoints"),
    "too many keypoints": (changed("keypoints1", lambda a: np.vstack([a, a[:1]])), "keypoints"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_results_are_refused_before_native_code(tmp_path, monkeypatch, scene, case):
    monkeypatch.setattr(pycolmap.Database, "open", lambda *_: pytest.fail("native code reached"))
    (tmp_path / "d.db").write_bytes(b"the former")
    change, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        write_database(tmp_path / "d.db", scene.images, change(scene.results), scene.cameras)
    assert (tmp_path / "d.db").read_bytes() == b"the former"


def test_a_keypoint_on_the_very_edge_is_inside(tmp_path, scene):
    edge = changed("keypoints0", put(0, [-0.5, 767.5]))(
        {p: scene.results[p] for p in list(scene.results)[:1]}
    )
    write_database(tmp_path / "d.db", scene.images, edge, scene.cameras)


# -- waiting ---------------------------------------------------------------------------------------


@pytest.fixture
def tokens(monkeypatch) -> list[pycolmap.CancellationToken]:
    """Every token made from now on."""
    made, create = [], pycolmap.CancellationToken
    monkeypatch.setattr(pycolmap, "CancellationToken", lambda: made.append(create()) or made[-1])
    return made


def test_ctrl_c_while_waiting_stops_native_code(tmp_path, monkeypatch, scene, tokens):
    write_database(tmp_path / "d.db", scene.images, scene.results, scene.cameras)
    wait, waited = threading.Event.wait, []

    def interrupted(event, timeout=None):
        if threading.current_thread() is not threading.main_thread() or timeout is None:
            return wait(event, timeout)
        waited.append(timeout)
        if len(waited) == 1:
            raise KeyboardInterrupt
        return wait(event, timeout)

    monkeypatch.setattr(threading.Event, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        map_database(tmp_path / "d.db", ONE)
    assert tokens[0].is_cancelled and len(waited) == 2
    assert all(thread.name != THREAD for thread in threading.enumerate())


def test_a_failure_beside_the_waiting_thread_is_raised(tmp_path, scene):
    def fail() -> None:
        raise ZeroDivisionError("the bar broke")

    write_database(tmp_path / "d.db", scene.images, scene.results, scene.cameras)
    with pytest.raises(Exception, match="the bar broke"):
        map_database(tmp_path / "d.db", ONE, on_image=fail)


def test_every_registered_image_is_counted(tmp_path, scene):
    counted = []
    write_database(tmp_path / "d.db", scene.images, scene.results, scene.cameras)
    map_database(tmp_path / "d.db", ONE, on_image=lambda: counted.append(1))
    assert len(counted) == len(scene.names)
