"""What is said before anything long starts, and how long it is expected to take."""

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxsfm.io.images import ImageFile
from jaxsfm.io.pair_selection import FEW
from jaxsfm.io.pairs import exhaustive_pairs
from jaxsfm.io.photo_folder import find_videos
from jaxsfm.runs import time_estimate
from jaxsfm.runs.first_words import MEASURED, first_words
from jaxsfm.runs.time_estimate import (
    HIGH_REST,
    LOW_REST,
    PAIRS,
    PHOTOS,
    Speed,
    expected_pairs,
    expected_s,
    first_pairs,
    in_words,
)

FOLDER = Path("PHOTOS")


def photo(name: str, size=(4032, 3024), taken_with="a camera") -> ImageFile:
    return ImageFile(
        name=name, path=FOLDER / name, size=size, sha256="0" * 64, taken_with=taken_with
    )


def photos(count: int) -> list[ImageFile]:
    return [photo(f"{k}.jpg") for k in range(count)]


def words(images, videos=()) -> str:
    return "\n".join(first_words(FOLDER, images, videos))


@pytest.mark.parametrize("count", [3, FEW, MEASURED])
def test_a_usual_folder_needs_no_words(count):
    assert first_words(FOLDER, photos(count), []) == []


def test_two_photos_are_told_that_nothing_can_check_their_model():
    assert "nothing can check" in words(photos(2)) and "a third photo" in words(photos(2))


def test_more_photos_than_were_ever_measured_are_told_to_begin_with_a_part():
    said = words(photos(5000))
    assert "5000 photos" in said and str(MEASURED) in said and "Try some hundred" in said


@pytest.mark.parametrize("size", [(1920, 1080), (1170, 2532), (2532, 1170)])
def test_screenshots_are_asked_about(size):
    shot = photo("shot.png", size, taken_with="")
    said = words([*photos(3), shot])
    assert said.startswith("shot.png is a PNG of a screen's size") and "frames of a video" in said
    assert "3 PNG" not in said and "and 1 more" in words([*photos(3), *[shot] * 4])


@pytest.mark.parametrize(
    "image",
    [
        photo("a.png", (1920, 1080)),  # EXIF names a camera
        photo("a.jpg", (1920, 1080), taken_with=""),  # a frame of a video
        photo("a.png", (1600, 1200), taken_with=""),  # no screen of today
    ],
)
def test_other_pictures_are_not_taken_for_screenshots(image):
    assert first_words(FOLDER, [*photos(3), image], []) == []


def test_a_video_beside_photos_is_named_with_the_command_that_uses_it():
    said = words(photos(3), ["way/clip.mp4"])
    assert "way/clip.mp4: videos among photos are not used" in said
    assert "jaxsfm frames 'PHOTOS/way/clip.mp4' --out 'PHOTOS/clip-frames'" in said.replace(
        "\\", "/"
    )


def test_the_video_of_a_live_photo_is_not_named():
    assert words(photos(3), ["1.MOV"]) == "" and "x.MOV" in words(photos(3), ["1.MOV", "x.MOV"])


def test_videos_are_found_in_sub_folders_but_not_in_hidden_ones(tmp_path):
    for name in ("a.jpg", "b.MP4", "way/c.mov", ".hidden/d.mp4", "way/.e.mp4"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    assert find_videos(tmp_path) == ["b.MP4", "way/c.mov"]


def test_an_estimate_is_the_sum_of_photos_and_pairs_and_of_what_follows():
    least, most = expected_s(Speed(2.0, 0.5), 10, 40)
    assert least == pytest.approx((1 + LOW_REST) * 40) and most == (1 + HIGH_REST) * 40
    assert most / least < 2  # an estimate that says less is none


@pytest.mark.parametrize(
    ("least", "most", "said"),
    [
        (2, 4, "10 seconds"),
        (44, 76, "40 to 80 seconds"),
        (100, 170, "100 to 170 seconds"),
        (130, 225, "2 to 4 minutes"),
        (6200, 10790, "103 to 180 minutes"),
        (7000, 12000, "2 to 3 hours"),
        (50000, 86000, "14 to 24 hours"),
    ],
)
def test_times_are_said_in_the_unit_that_suits_them(least, most, said):
    assert in_words(least, most) == said


def test_the_first_pairs_are_few_and_touch_few_photos():
    names = [f"img{k}.jpg" for k in range(30)]
    chosen = first_pairs(exhaustive_pairs(names))
    assert len(chosen) == PAIRS and len({n for pair in chosen for n in pair}) <= PHOTOS
    assert {n for pair in chosen for n in pair} <= {f"img{k}.jpg" for k in range(PHOTOS)}
    assert len(first_pairs([("a", "b")])) == 1 and first_pairs([]) == []


def test_pairs_of_retrieval_are_guessed_and_never_more_than_there_are():
    assert expected_pairs(190, 20, 0) == 190
    assert expected_pairs(0, 500, 20) == pytest.approx(5761, rel=0.1)  # measured on kitchen
    assert expected_pairs(0, 50, 20) == pytest.approx(573, rel=0.1)
    assert expected_pairs(0, 10, 20) == 45


def test_the_first_photos_and_pairs_are_measured_without_those_that_compile(monkeypatch):
    assert time_estimate._median_step([0, 50, 60, 61, 63]) == 1.5
    assert time_estimate._median_step([0, 50, 60]) is None


def a_run(count: int, *, described=False, matched=False, workers=False) -> Any:
    """The photos of a run that has just begun, or has got so far already."""
    images = {f"{k}.jpg": photo(f"{k}.jpg") for k in range(count)}
    store = SimpleNamespace(
        has_features=lambda image: described and image.name == "3.jpg",
        load_matches=lambda pair: "matches" if matched and pair == ("0.jpg", "1.jpg") else None,
    )
    job = SimpleNamespace(
        engine=SimpleNamespace(starts_workers=workers), execution=None, store=store, config=None
    )
    pairs = exhaustive_pairs(images)
    return SimpleNamespace(images=images, pairs=pairs, job=job, identity=None)


@pytest.fixture
def said(monkeypatch, caplog) -> Callable[..., str]:
    """What is said of a run on a machine where a photo takes 2 s and a pair 0.5 s."""

    def ask(run, *, retrieval=0, platform="cpu") -> str:
        devices = np.array([SimpleNamespace(platform=platform)])
        monkeypatch.setattr(
            time_estimate, "select_devices", lambda _: SimpleNamespace(devices=devices)
        )
        monkeypatch.setattr(time_estimate, "low_resolution", lambda *_: None)
        monkeypatch.setattr(time_estimate, "job_at_size", lambda job, *_: job)
        monkeypatch.setattr(time_estimate, "_measured", lambda *_: Speed(2.0, 0.5))
        caplog.clear()
        with caplog.at_level("INFO", "jaxsfm"):
            time_estimate.tell_time(run, retrieval, {})
        return caplog.text

    return ask


def test_a_run_that_has_just_begun_says_how_long_it_will_take(said):
    assert "20 photos and 190 pairs will take 3 to 6 minutes in all" in said(a_run(20))
    assert "20 photos and about 190 pairs" in said(a_run(20), retrieval=20)


def test_nothing_is_measured_where_it_would_say_little_or_cost_something(said):
    assert said(a_run(PHOTOS)) == "" != said(a_run(PHOTOS + 1))
    assert said(a_run(20, described=True)) == ""
    assert said(a_run(20, matched=True)) == ""
    assert said(a_run(20, workers=True)) == ""
    assert said(a_run(20), platform="gpu") == ""


def test_the_numbers_of_the_estimate_are_those_of_the_documents():
    said = (Path(__file__).parents[2] / "docs" / "performance.md").read_text(encoding="utf-8")
    low, high = re.search(r"between ([\d.]+) and ([\d.]+) times as long", said).groups()
    assert (float(low), float(high)) == (LOW_REST, HIGH_REST)
