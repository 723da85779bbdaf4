"""Damaged reports of finished runs: the page, the viewer's scene, exports, or one sentence."""

import json

import msgspec
import pytest
from foreign_model import NAMES, camera, exact_model, write_run
from fuzz_children import run_cases
from mutations import damaged_json, outcome

from jaxsfm.cli.export_commands import _recorded_photos
from jaxsfm.report.finished_run import read_run
from jaxsfm.report.page.write import page
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.scene import shown_scene

ERRORS = {"mean": 0.01, "median": 0.02, "max": 0.03}
VERDICT = {"trusted": True, "edge_weight": 0.5, "rotation_error_deg": 0.1, "reason": ""}
CHECK = {
    "groups": [sorted(NAMES)[:2], sorted(NAMES)[2:3]],
    "contradictions": [
        {
            "images": sorted(NAMES)[:2],
            "others": sorted(NAMES)[2:3],
            "tested": 20,
            "contradicted": 9,
        }
    ],
    "pose_ambiguities": [
        {
            "image": sorted(NAMES)[0],
            "pairs": sorted(NAMES)[1:2],
            "agreed": 20,
            "contradicted": 1,
            "rotation_deg": 90.0,
        }
    ],
}
NEAREST = {"pair": [NAMES[0], NAMES[3]], "missed": "7 tentative matches, 26 are needed"}


def pair(a: str, b: str, inliers: int = 40, verdict=VERDICT) -> dict:
    return {
        "pair": [a, b],
        "status": "verified",
        "tentative": 50,
        "inliers": inliers,
        "planes": 1,
        "handed_on": True,
        "colmap_inliers": inliers,
        "view_graph": verdict,
    }


def whole(folder) -> dict:
    """The report of a run with all parts; one image is lost."""
    names = sorted(NAMES)
    return {
        "version": "0",
        "versions": {"jaxsfm": "0"},
        "finished": "2024-01-01",
        "identity": {
            "version": "0",
            "images": dict.fromkeys(names, "0"),
            "config": {"octaves": 2},
            "seed": 0,
        },
        "weights": {"backbone": "vgg16"},
        "options": {
            "config": {"max_size": 640, "enlarge": 1.0, "octaves": 2, "min_inliers": 26},
            "mapper": "incremental",
            "best_pairs": None,
            "execution": {"devices": None, "memory_gb": None},
            "seed": 0,
            "threads": -1,
            "pairs": "exhaustive",
            "intrinsics": None,
            "reference": None,
        },
        "images": {"folder": str(folder), "found": 5, "usable": 4, "skipped": {"e.jpg": "empty"}},
        "pairs": {
            "tried": 6,
            "verified": 3,
            "handed_on": 3,
            "overflowed": 0,
            "each": [
                pair(names[0], names[1]),
                pair(names[1], names[2], 30, None),
                pair(names[2], names[3], 9, {**VERDICT, "trusted": False, "reason": "odd"}),
                {**pair(names[0], names[3]), "inliers": 0},
            ],
        },
        "models": [
            {
                "registered": 3,
                "points": 20,
                "track_length": 2.5,
                "reprojection_error_px": 0.5,
                "images": names[:3],
            }
        ],
        "lost": [
            {
                "image": names[3],
                "stage": "no plane",
                "detail": "few",
                "help": [{"option": "--preset robust", "reason": "small"}],
            }
        ],
        "view_graph": {
            "components": [
                {"images": names[:2], "pairs": 1, "registered": 2, "nearest": NEAREST},
                {"images": names[2:], "pairs": 1, "registered": 1, "nearest": None},
            ]
        },
        "evaluation": {
            "registered": 3,
            "reference_images": 4,
            "aligned_on": 3,
            "position": ERRORS,
            "rotation_deg": ERRORS,
            "within_10deg": {"0.5": 1.0},
            "images": {name: {"position": 0.1, "rotation_deg": 0.2} for name in names[:3]},
        },
        "no_model": None,
        "refinement": [None],
        "checks": [CHECK],
        "seconds": {"mapping": 1.5, "matching": 2},
    }


def report(rng, folder) -> str:
    out = folder / "run"
    if not out.exists():
        write_run(out, exact_model([camera("PINHOLE")], points=20))
    (out / "report.json").write_bytes(damaged_json(whole(folder), rng))
    _recorded_photos(out)

    def show() -> None:
        run = read_run(out)
        assert page(run).startswith("<!doctype html>")
        if run.model is not None:
            shown_scene(run)

    return outcome(show, out)[0]


def test_a_damaged_report_is_shown_or_refused_by_name(tmp_path, share, least):
    # Of the larger report about one damaged copy in sixteen can still be read.
    found = run_cases("test_fuzz_reports", "report", round(500 * share), tmp_path)
    assert found["read"] > 20 * least and found["refused"] > 100 * least


def test_what_runs_report_is_what_their_readers_need(plain, tmp_path):
    """The types that are checked are those of real reports, and an error names the place."""

    def refusal(value) -> str:
        with pytest.raises(msgspec.ValidationError) as error:
            RunReport.from_json(value)
        return str(error.value)

    real = plain[1]
    assert RunReport.from_json(real).to_json() == real
    RunReport.from_json(whole(tmp_path))
    assert refusal([]) == "Expected `object`, got `array`"
    assert refusal({**real, "lost": None}).endswith("at `$.lost`")
    real = json.loads(json.dumps(real))
    real["pairs"]["each"][1]["view_graph"]["edge_weight"] = "0.5"
    assert refusal(real).endswith("at `$.pairs.each[1].view_graph.edge_weight`")
