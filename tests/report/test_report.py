"""The summary of a run."""

from pathlib import Path

import pytest

from jaxsfm.io.images import ImageError, inspect_image
from jaxsfm.report.finished_run import masks_folder
from jaxsfm.report.run_inputs import LowResolution
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.summary import summary_lines

MODEL = {
    "registered": 2,
    "points": 321,
    "track_length": 2.5,
    "reprojection_error_px": 0.71,
    "images": ["a", "b"],
}
PAIRS = {"tried": 3, "verified": 2, "handed_on": 1, "trusted": 1, "overflowed": 0, "each": []}
OPTIONS = {
    "config": {"max_size": 1600, "enlarge": 1.0},
    "pairs": "exhaustive",
    "intrinsics": None,
    "seed": 0,
    "threads": -1,
}


def report(**changes) -> RunReport:
    plain = {
        "version": "0",
        "identity": {"version": "0", "config": {}, "images": {}},
        "weights": {},
        "options": OPTIONS,
        "images": {"found": 4, "usable": 3, "skipped": {}},
        "pairs": PAIRS,
        "models": [MODEL],
        "mapping": [{"mapper": "incremental", "initial_pair": None, "registered": [2]}],
        "refinement": [],
        "seconds": {"extraction": 1.25, "mapping": 2.0},
        "lost": [],
        "no_model": None,
    }
    return RunReport.from_json(plain | changes)


def test_a_summary_has_the_counts_of_every_stage():
    text = "\n".join(summary_lines(report()))
    for part in ("3 usable of 4", "3 tried, 2 verified, 1 handed", "2 of 3 images", "321", "0.71"):
        assert part in text
    assert "warning" not in text and "smaller" not in text and "reference" not in text
    assert "and 1 smaller model" in "\n".join(summary_lines(report(models=[MODEL, MODEL])))
    assert "none of 3 images" in "\n".join(summary_lines(report(models=[])))


def test_panoramas_are_counted_beside_their_views():
    lines = summary_lines(report(panoramas={"found": 4, "registered": 3}))
    assert any(line.startswith("panoramas        3 of 4 have a place") for line in lines)
    assert "panoramas" not in "\n".join(summary_lines(report()))
    assert "panoramas" not in report().to_json()


def test_second_tries_and_refinement_are_said():
    figures = {
        "accepted": True,
        "candidates": 9,
        "kept": 5,
        "dropped": 3,
        "added": 4,
        "weak_views": ["night"],
        "points": 321,
        "reprojection_error_px": 0.71,
    }
    start = {"mapper": "incremental", "initial_pair": ["a", "b"]}
    attempts = [start | {"registered": []}, start | {"registered": [2, 1]}]
    night = {
        "name": "night",
        "registered": True,
        "candidates": 900,
        "agreed": 7,
        "octave_px": None,
        "error_px": None,
    }
    dusk = night | {"name": "dusk", "agreed": 321, "octave_px": 4, "error_px": 1.26}
    late = dusk | {"name": "late", "registered": False}
    never = night | {"name": "never", "registered": False}
    doubtful = late | {"name": "doubtful", "reason": "its neighbour does not agree with it"}
    done = {
        "passes": [figures, figures],
        "registrations": [night, dusk, dusk | {"octave_px": 1}, late, never, doubtful],
    }
    text = "\n".join(summary_lines(report(mapping=attempts, refinement=[done])))
    assert "started 2 times, images registered: 0, 2" in text
    assert "5 observations agreed, 3 dropped, 4 added in the last of 2 passes" in text
    assert "not refined      night" in text and "taken back" not in text
    assert (
        "registered       dusk: 321 points agree at 1/4 size, with a median error of 1.3 px" in text
    )
    assert "registered       dusk: 321 points agree at full size" in text
    assert (
        "late: 321 points agree at 1/4 size, with a median error of 1.3 px; it had no place" in text
    )
    assert (
        "never" not in text and text.count("it had no place before") == 1 and "doubtful" not in text
    )
    assert "camera  " not in text
    back = {"passes": [figures | {"accepted": False}], "registrations": []}
    other = {"model": "PINHOLE", "params": [5, 5, 3, 2], "distance_px": 4.52, "halves_px": 0.44}
    text = "\n".join(summary_lines(report(refinement=[back | {"camera": other}])))
    assert "too few agreed, so this pass was taken back" in text
    assert "camera           the photos speak for another one, PINHOLE:5,5,3,2. It mov" in text
    assert "4.5 px, and two halves of the points agree on it to 0.4 px" in text


def test_a_failed_evaluation_is_said():
    lines = summary_lines(report(evaluation_failed="no common images"))
    assert lines[-1] == "not evaluated    no common images"


def test_overflow_and_evaluation_are_said():
    pairs = PAIRS | {"overflowed": 2}
    errors = {"mean": 0.01, "median": 0.02, "max": 0.03}
    evaluation = {
        "registered": 2,
        "reference_images": 3,
        "aligned_on": 2,
        "position": errors,
        "rotation_deg": errors,
        "within_10deg": {"0.5": 2 / 3},
        "images": {},
    }
    text = "\n".join(summary_lines(report(pairs=pairs, evaluation=evaluation)))
    assert "2 pairs had more matches than could be kept" in text
    assert "2 of 3 images, aligned on 2" in text and "0.5: 67 %" in text
    assert text.count("mean 0.0100  median 0.0200  max 0.0300") == 2


def test_skipped_and_lost_images_have_one_line_each_whatever_their_names(tmp_path):
    name = "new\nline\x1b[31m.jpg"
    (tmp_path / name).write_text("not an image")
    with pytest.raises(ImageError) as error:
        inspect_image(tmp_path / name, name=name)
    rows = [{"image": "lost\n.jpg", "stage": "no plane", "detail": "5 tentative matches"}]
    images = {"found": 4, "usable": 3, "skipped": {name: str(error.value)}}
    lines = summary_lines(report(images=images, lost=rows))
    assert all(line.isprintable() for line in lines)
    assert [line for line in lines if line.startswith("skipped")] == [
        r"skipped          new\nline\x1b[31m.jpg: not a readable image"
    ]
    assert [line for line in lines if line.startswith("lost")] == [
        r"lost             lost\n.jpg: no plane (5 tentative matches)"
    ]


def test_the_masks_of_a_run_are_those_of_the_user():
    assert masks_folder(report()) is None
    assert masks_folder(report(options=OPTIONS | {"masks": "/m"})) == Path("/m")


@pytest.mark.parametrize(
    ("whole", "said"),
    [
        (False, "photos were described at 800 px"),
        (True, "no model was made of photos of 800 px, so they were matched at full size"),
    ],
)
def test_at_what_size_photos_were_described_is_said(whole, said):
    assert LowResolution(px=800, whole=whole).in_words() == said
    lines = summary_lines(report(low_resolution={"px": 800, "whole": whole}))
    assert f"low resolution   {said}" in lines
    assert not any(line.startswith("low_resolution") for line in summary_lines(report()))
