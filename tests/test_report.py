"""Why images were lost, and a run's last lines."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsfm.core.types import Status
from jaxsfm.host.images import ImageError, inspect_image
from jaxsfm.host.pairs import PairResult, component_of, exhaustive_pairs
from jaxsfm.report import lost_images, summary_lines

edges = st.lists(st.sampled_from(exhaustive_pairs("abcdefg")), max_size=10)


@settings(max_examples=40, deadline=None)
@given(st.sets(st.sampled_from("abcdefg")), edges)
def test_a_component_is_what_repeated_steps_reach(seeds, edges):
    slow = set(seeds)
    for _ in "abcdefg":
        slow |= {x for pair in edges if slow & set(pair) for x in pair}
    assert component_of(seeds, edges) == slow == component_of(sorted(seeds)[::-1], edges[::-1])


def result(a: str, b: str, status: Status, tentative: int, inliers: int = 0) -> PairResult:
    return PairResult(
        pair=(a, b),
        cells=np.zeros((inliers, 2), np.int32),
        keypoints0=np.zeros((inliers, 2), np.float32),
        keypoints1=np.zeros((inliers, 2), np.float32),
        plane=np.zeros(inliers, np.int32),
        homographies=np.zeros((0, 3, 3)),
        num_tentative=tentative,
        num_dropped=0,
        status=status,
    )


RESULTS = [
    result("m0", "m1", Status.VERIFIED, 500, 400),
    result("few", "m0", Status.TOO_FEW_MATCHES, 3),
    result("few", "m1", Status.TOO_FEW_MATCHES, 7),
    result("flat", "m0", Status.NO_PLANE, 90),
    result("few", "flat", Status.TOO_FEW_MATCHES, 2),
    result("alone", "m0", Status.VERIFIED, 60, 30),  # COLMAP verifies none of them
    result("island0", "island1", Status.VERIFIED, 80, 70),
    result("m1", "odd", Status.VERIFIED, 100, 55),
]
VERIFIED = {("m0", "m1"): 390, ("island0", "island1"): 66, ("m1", "odd"): 44}
STAGES = {
    "alone": ("not connected", "30 inliers in its best pair, 0 pairs verified"),
    "few": ("too few matches", "at most 7 tentative"),
    "flat": ("no plane", "90 tentative"),
    "island0": ("not connected", "70 inliers in its best pair, 1 pairs verified"),
    "island1": ("not connected", "none leads to the model"),
    "never": ("pairs", "in no pair"),
    "odd": ("no pose", "1 verified pairs with up to 44 inliers"),
}


def lost(registered) -> dict[str, dict[str, str]]:
    names = ["m0", "m1", *STAGES]
    rows = lost_images(names, registered, {r.pair: r for r in RESULTS}, VERIFIED)
    assert [row["image"] for row in rows] == sorted(set(names) - set(registered))
    return {row["image"]: row for row in rows}


def test_every_lost_image_names_the_stage_that_lost_it():
    rows = lost(["m0", "m1"])
    assert rows.keys() == STAGES.keys()
    for name, (stage, detail) in STAGES.items():
        assert rows[name]["stage"] == stage and detail in rows[name]["detail"], name


def test_without_a_model_no_image_is_called_connected():
    assert {row["stage"] for row in lost([]).values()} >= {"not connected", "no plane", "pairs"}
    assert lost([])["m0"]["stage"] == "no pose"


def test_registered_images_are_not_lost():
    assert lost_images(["m0", "m1"], ["m1", "m0"], {}, {}) == []


# -- the last lines --------------------------------------------------------------------------------

MODEL = {"registered": 2, "points": 321, "track_length": 2.5, "reprojection_error_px": 0.71}


def report(**changes) -> dict:
    return {
        "images": {"found": 4, "usable": 3, "skipped": {}},
        "pairs": {"tried": 3, "verified": 2, "handed_on": 1, "trusted": 1, "overflowed": 0},
        "models": [MODEL],
        "mapping": [{"mapper": "incremental", "initial_pair": None, "registered": [2]}],
        "refinement": [],
        "seconds": {"extraction": 1.25, "mapping": 2.0},
        "lost": [],
        **changes,
    }


def test_a_summary_has_the_counts_of_every_stage():
    text = "\n".join(summary_lines(report()))
    for part in ("3 usable of 4", "3 tried, 2 verified, 1 handed", "2 of 3 images", "321", "0.71"):
        assert part in text
    assert "warning" not in text and "smaller" not in text and "reference" not in text
    assert "and 1 smaller model" in "\n".join(summary_lines(report(models=[MODEL, MODEL])))
    assert "none: no model" in "\n".join(summary_lines(report(models=[])))


def test_second_tries_and_refinement_are_said():
    figures = {"accepted": True, "kept": 5, "dropped": 3, "added": 4, "weak_views": ["night"]}
    attempts = [{"registered": []}, {"registered": [2, 1]}]
    night = {"name": "night", "registered": True, "agreed": 7, "octave_px": None, "error_px": None}
    dusk = night | {"name": "dusk", "agreed": 321, "octave_px": 4, "error_px": 1.26}
    late = dusk | {"name": "late", "registered": False}
    never = night | {"name": "never", "registered": False}
    done = {
        "passes": [figures, figures],
        "placed": [night, dusk, dusk | {"octave_px": 1}, late, never],
    }
    text = "\n".join(summary_lines(report(mapping=attempts, refinement=[done])))
    assert "started 2 times, images registered: 0, 2" in text
    assert "5 observations agreed, 3 dropped, 4 added in the last of 2 passes" in text
    assert "not refined      night" in text and "taken back" not in text
    assert "placed           dusk: 321 points agree at 1/4 size, 1.3 px" in text
    assert "placed           dusk: 321 points agree at full size" in text
    assert "late: 321 points agree at 1/4 size, 1.3 px; the mapper had left it out" in text
    assert "never" not in text and text.count("left it out") == 1
    back = {"passes": [figures | {"accepted": False}], "placed": []}
    text = "\n".join(summary_lines(report(refinement=[back])))
    assert "too few, taken back" in text


def test_images_that_the_view_graph_cut_off_are_told_how_to_keep_them():
    results = {("a", "b"): result("a", "b", Status.VERIFIED, 60, 30)}
    (row,) = [r for r in lost_images("ab", "b", results, {}, [("a", "b")])]
    assert row["stage"] == "not connected" and "--view-graph no" in row["detail"]


def test_a_failed_evaluation_is_said():
    lines = summary_lines(report(evaluation_failed="no common images"))
    assert lines[-1] == "not evaluated    no common images"


def test_overflow_and_evaluation_are_said():
    pairs = {"tried": 3, "verified": 2, "handed_on": 1, "trusted": 1, "overflowed": 2}
    errors = {"mean": 0.01, "median": 0.02, "max": 0.03}
    evaluation = {
        "registered": 2,
        "reference_images": 3,
        "aligned_on": 2,
        "position": errors,
        "rotation_deg": errors,
        "within_10deg": {"0.5": 2 / 3},
    }
    text = "\n".join(summary_lines(report(pairs=pairs, evaluation=evaluation)))
    assert "2 pairs had more matches than kept" in text
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
