"""The folder of chosen frames, and the reconstruction of a video."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from moving_views import views, write_video

from jaxsfm.config import preset
from jaxsfm.errors import UserError
from jaxsfm.io.pair_selection import FEW, MOST_NEIGHBOURS, chosen_pairs, many_frames
from jaxsfm.io.photo_folder import find_images
from jaxsfm.io.work_folder import lock_folder
from jaxsfm.runs import reconstruct as reconstruct_module
from jaxsfm.runs.reconstruct import reconstruct_video
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.runs.video import frames as frames_module
from jaxsfm.runs.video.frames import FrameOptions, frames_folder


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video") / "a.avi", views(range(0, 400, 10)), "MJPG")


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_frames_are_named_by_their_numbers_and_look_like_the_video(tmp_path, video):
    found = frames_folder(video, tmp_path / "out")
    assert found.names == find_images(tmp_path / "out")
    assert len(found.names) > 4 and not found.there
    for name in found.names:
        number = int(name.removeprefix("frame-").removesuffix(".jpg"))
        (given,) = views(range(0, 400, 10))[number : number + 1]
        frame = cv2.imread(str(tmp_path / "out" / name))
        assert np.abs(frame.astype(float) - given).mean() < 6
    assert 0.7 < found.common < 0.9


def test_a_second_call_finds_the_frames_and_changes_nothing(tmp_path, video, monkeypatch):
    out = tmp_path / "out"
    first = frames_folder(video, out, FrameOptions(overlap=0.85))
    before = content(out)
    monkeypatch.setattr(frames_module, "choose_frames", None)
    for options in (FrameOptions(overlap=0.85), None):
        again = frames_folder(video, out, options)
        assert again == first._replace(there=True)
    assert content(out) == before
    (out / first.names[1]).unlink()
    assert first.names[1] not in frames_folder(video, out).names


def test_frames_of_other_calls_are_not_mixed(tmp_path, video):
    out = tmp_path / "out"
    frames_folder(video, out, FrameOptions(overlap=0.7))
    before = content(out)
    other = write_video(tmp_path / "b.avi", views(range(0, 300, 10), seed=1), "MJPG")
    for source, options, message in (
        (video, FrameOptions(overlap=0.8), "another --overlap"),
        (video, FrameOptions(overlap=0.7, most=2), "another --most"),
        (other, FrameOptions(overlap=0.7), "of another video"),
        (other, None, "of another video"),
    ):
        with pytest.raises(UserError, match=message):
            frames_folder(source, out, options)
    assert content(out) == before


def test_a_folder_of_something_else_is_left_alone(tmp_path, video):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match=r"out: the folder is not empty \(it holds 'mine.txt'\)"):
        frames_folder(video, out)
    (out / "mine.txt").unlink()
    assert frames_folder(video, out).names  # an empty folder is as good as none
    with pytest.raises(UserError, match="this is a file and not a folder"):
        frames_folder(video, out / "frames.json")


def test_most_keeps_frames_at_equal_steps(tmp_path, video):
    every = frames_folder(video, tmp_path / "every", FrameOptions(overlap=0.9))
    few = frames_folder(video, tmp_path / "few", FrameOptions(overlap=0.9, most=4))
    assert len(every.names) > 8 and len(few.names) == 4
    assert few.names == find_images(tmp_path / "few")
    assert {*few.names} < {*every.names}
    assert (few.names[0], few.names[-1]) == (every.names[0], every.names[-1])
    numbers = np.asarray([int(name[6:12]) for name in few.names])
    gaps = np.diff(numbers)
    assert gaps.max() <= 1.5 * gaps.min()
    record = json.loads((tmp_path / "few" / "frames.json").read_text())
    common = [record["frames"][name] for name in few.names]
    assert common[0] is None
    # Ten pixels from frame to frame, of 320.
    np.testing.assert_allclose(common[1:], 1 - 10 * gaps / 320, atol=0.02)


def test_a_failure_leaves_nothing_behind(tmp_path, video, monkeypatch):
    def broken(frame):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(frames_module, "_jpeg", broken)
    with pytest.raises(UserError, match="out: cannot be written .No space left"):
        frames_folder(video, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_video_without_motion_is_refused(tmp_path):
    still = write_video(tmp_path / "still.avi", views([0] * 12), "MJPG")
    with pytest.raises(UserError, match="still.avi: the camera hardly moves"):
        frames_folder(still, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"overlap": 1.0}, "--overlap must lie in 0.2 .. 0.98; got 1"),
        ({"overlap": 0.1}, "--overlap"),
        ({"overlap": float("nan")}, "--overlap"),
        ({"most": 1}, "--most must be at least 2; got 1"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(options, message):
    with pytest.raises(UserError, match=message):
        FrameOptions(**options)


# -- reconstruct VIDEO ----------------------------------------------------------------------------


def test_frames_that_share_enough_are_neighbours():
    assert many_frames(0.8) == "retrieval:20+sequential:3"
    assert many_frames(0.9) == "retrieval:20+sequential:6"
    assert many_frames(0.0) == "retrieval:20+sequential:2"
    assert many_frames(1.0) == f"retrieval:20+sequential:{MOST_NEIGHBOURS}"
    assert chosen_pairs("auto", FEW + 1, many_frames(0.9)) == many_frames(0.9)
    assert chosen_pairs("auto", FEW, many_frames(0.9)) == "exhaustive"
    assert chosen_pairs("sequential:7", FEW + 1, many_frames(0.9)) == "sequential:7"


def test_a_video_is_reconstructed_from_the_frames_in_the_work_folder(tmp_path, video, monkeypatch):
    calls = []

    def instead(images, out, *, config, options):
        calls.append((images, out, options.pairs, find_images(images)))

    monkeypatch.setattr(reconstruct_module, "reconstruct_folder", instead)
    monkeypatch.setattr("jaxsfm.io.pair_selection.FEW", 3)
    out = tmp_path / "out"
    for pairs in ("auto", "auto", "exhaustive"):
        reconstruct_video(video, out, config=preset("default"), options=RunOptions(pairs=pairs))
    (first, again, other) = calls
    assert first == again and first[0] == out / "frames" and len(first[3]) > 4
    assert first[2] == many_frames(frames_folder(video, out / "frames").common)
    assert other[2] == "exhaustive"


def test_a_work_folder_may_begin_with_frames_and_with_nothing_else(tmp_path, video):
    out = tmp_path / "out"
    frames_folder(video, out / "frames", FrameOptions(overlap=0.7))
    with lock_folder(out):
        pass
    (out / "frames.partial").mkdir()  # of a process that was killed
    with lock_folder(out):
        pass
    strange = tmp_path / "strange"
    (strange / "frames").mkdir(parents=True)
    (strange / "frames" / "mine.jpg").touch()
    with pytest.raises(UserError, match="not a jaxsfm run .it holds 'frames'"):
        with lock_folder(strange):
            pass
