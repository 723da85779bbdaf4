"""Reading video files."""

import logging

import numpy as np
import pytest
from moving_views import HEIGHT, WIDTH, ask_for_turn, views, write_video

from jaxsfm.errors import UserError
from jaxsfm.io.video import open_video


def read(path):
    with open_video(path) as video:
        return list(video.frames())


@pytest.mark.parametrize("name, codec", [("a.avi", "MJPG"), ("a b:c.mp4", "mp4v")])
def test_the_frames_of_a_video_come_in_order(tmp_path, name, codec):
    frames = views(range(0, 60, 12))
    path = write_video(tmp_path / name, frames, codec)
    with open_video(path) as video:
        assert video.announced == len(frames)
        found = list(video.frames())
    assert len(found) == len(frames)
    for frame, given in zip(found, frames, strict=True):
        errors = [np.abs(frame.astype(float) - other).mean() for other in frames]
        assert np.abs(frame.astype(float) - given).mean() == min(errors)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_frames_are_turned_as_the_video_asks(tmp_path, quarters):
    frames = views([0, 8])
    path = write_video(tmp_path / "a.mp4", frames)
    ask_for_turn(path, quarters)
    (frame, _) = read(path)
    expected = np.rot90(frames[0], -quarters)
    assert frame.shape == expected.shape
    assert np.abs(frame.astype(float) - expected).mean() < 15


def test_what_is_not_a_video_is_refused_by_name(tmp_path):
    photo, text, other, empty, folder = (
        tmp_path / n for n in ("a.jpg", "a.txt", "a.zip", "a.mp4", "folder")
    )
    other.write_bytes(bytes(range(256)) * 20)
    photo.write_bytes(b"\xff\xd8")
    text.write_text("no video\n" * 100)
    empty.touch()
    folder.mkdir()
    for path, message in (
        (tmp_path / "none.mp4", "no such file"),
        (folder, "not a file"),
        (empty, "the file is empty"),
        (photo, "this is a photo and not a video"),
        (text, "this is a text and not a video"),
        (other, "not a video that can be read"),
    ):
        with pytest.raises(UserError, match=message) as error:
            read(path)
        assert str(path) in str(error.value)


def test_a_video_without_frames_is_refused(tmp_path):
    path = write_video(tmp_path / "a.avi", views([0, 8]), "MJPG")
    data = bytearray(path.read_bytes())
    at = data.index(b"movi")
    data[at + 4 :] = bytes(len(data) - at - 4)
    path.write_bytes(data)
    with pytest.raises(UserError, match="no frame of this video|not a video"):
        read(path)


def test_a_video_that_is_cut_off_is_read_as_far_as_it_goes_and_the_log_says_so(tmp_path, caplog):
    frames = views(range(0, 200, 10))
    path = write_video(tmp_path / "a.avi", frames, "MJPG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with caplog.at_level(logging.WARNING, "jaxsfm"):
        found = read(path)
    assert 5 < len(found) < 15
    assert f"only the first {len(found)} of" in caplog.text


def test_a_frame_has_the_pixels_of_the_video(tmp_path):
    (frame,) = read(write_video(tmp_path / "a.avi", views([0]), "MJPG"))
    assert frame.shape == (HEIGHT, WIDTH, 3) and frame.dtype == np.uint8
