"""`bench ledger`: its sets, the runs that it makes or finds, and its tables."""

import json
import os
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from test_outcomes import moved, part, ring, similarity
from verdicts import check_of

from jaxsfm.bench import ledger, ledger_runs
from jaxsfm.bench.ledger import bench_ledger
from jaxsfm.bench.ledger_runs import SECONDS, LedgerRun, SetPhotos, apart, run_set
from jaxsfm.bench.ledger_sets import (
    DRAWN,
    as_frames,
    as_phototourism,
    as_turned,
    choose_ledger_sets,
    ledger_sets,
)
from jaxsfm.bench.ledger_table import (
    THRESHOLDS,
    counts,
    error_curve,
    markdown,
    set_cells,
    table_lines,
)
from jaxsfm.bench.model_options import LedgerOptions
from jaxsfm.bench.synthetic import camera_text, write_photo
from jaxsfm.cli.main import main
from jaxsfm.colmap.model_files import write_models
from jaxsfm.errors import UserError
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.run_options import RunOptions

SET = "Herz-Jesus-P8"
TRUTH = ring(8)
K = np.asarray([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])


def write_set(root, name=SET):
    """A set in Strecha's layout with the cameras TRUTH; photo k has a mark at the pixel (k, 0)."""
    folder = root / "strecha" / name
    (folder / "images").mkdir(parents=True)
    (folder / "gt_dense_cameras").mkdir()
    np.savetxt(folder / "images" / "K.txt", K)
    for k, (photo, pose) in enumerate(TRUTH.items()):
        rgb = np.zeros((24, 32, 3), np.uint8)
        rgb[0, k] = 255
        write_photo(folder / "images" / photo, rgb)
        path = folder / "gt_dense_cameras" / f"{photo}.camera"
        path.write_text(camera_text(K, pose, (32, 24)))
    return folder


def colmap_model(poses):
    """A model without points."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=32, height=24, params=[30, 30, 16, 12], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    for k, (name, pose) in enumerate(poses.items(), 1):
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), -pose.rotation @ pose.centre)
        image = pycolmap.Image(name=name, camera_id=1, image_id=k)
        model.add_image_with_trivial_frame(image, rigid)
    return model


def write_run(folder, models, colour="green", **changes):
    """What a run leaves in its folder: its models and its report."""
    rows = [
        {
            "registered": len(poses),
            "points": 100,
            "track_length": 3.0,
            "reprojection_error_px": 0.5,
            "images": sorted(poses),
        }
        for poses in models
    ]
    report = {
        "version": "0",
        "identity": {"version": "0", "config": {}, "images": {}},
        "weights": {},
        "options": {
            "config": {"max_size": 1600, "enlarge": 1.0},
            "pairs": "exhaustive",
            "intrinsics": None,
            "seed": 0,
            "threads": -1,
        },
        "images": {"found": 8, "usable": 8, "skipped": {}},
        "pairs": {"tried": 0, "verified": 0, "handed_on": 0, "overflowed": 0, "each": []},
        "models": rows,
        "checks": [to_json(check_of(colour)) for _ in models],
        "seconds": {"matching": 20.0, "mapping": 10.0},
        "lost": [],
        "no_model": None if models else "no pair",
    }
    folder.mkdir(parents=True)
    if models:
        write_models([colmap_model(poses) for poses in models], folder / "sparse")
    (folder / "report.json").write_text(json.dumps(report | changes))


def write_rootsift(out, poses, seconds=10.0):
    folder = out / SET / "seed0" / "rootsift"
    write_models([colmap_model(poses)], folder / "sparse")
    (folder / SECONDS).write_text(json.dumps({"matching": seconds}))


def judged_rows(root, out, **more):
    more = {"sets": (SET,), "seeds": 2, "only_judge": True} | more
    return bench_ledger(LedgerOptions(root=root, out=out, **more))["rows"]


# -- the sets --------------------------------------------------------------------------------------


def test_only_sets_whose_data_are_there_and_all_rendered_scenes_are_sets(tmp_path):
    drawn = {*ledger_sets(tmp_path)}
    assert len(drawn) == 2 * DRAWN
    write_set(tmp_path)
    assert {*ledger_sets(tmp_path)} - drawn == {SET, "turned-Herz-Jesus"}


def test_each_half_of_the_rendered_scenes_has_all_sorts_of_scene(tmp_path):
    for kind in ("ordinary", "ambiguous"):
        sorts = {
            half: {
                each.name.rpartition("-")[0]
                for each in ledger_sets(tmp_path).values()
                if (each.kind, each.half) == (kind, half)
            }
            for half in ("choose", "report")
        }
        assert sorts["choose"] == sorts["report"] and len(sorts["choose"]) > 4
    for each in ledger_sets(tmp_path).values():
        even = int(each.name.rpartition("-")[2]) % 2 == 0
        assert each.half == ("choose" if even else "report")


def test_sets_are_chosen_by_name_or_by_pattern(tmp_path):
    names = [each.name for each in choose_ledger_sets(tmp_path, ["synthetic-box-*"])]
    assert names and all(name.startswith("synthetic-box-") for name in names)
    twice = choose_ledger_sets(tmp_path, [names[0], "synthetic-box-*"])
    assert [each.name for each in twice] == names
    with pytest.raises(UserError, match="no set 'castle-P19'"):
        choose_ledger_sets(tmp_path, ["castle-P19"])


def test_a_rendered_scene_is_written_once_and_its_camera_is_known(tmp_path):
    (each,) = choose_ledger_sets(tmp_path, ["synthetic-room-00"])
    given = each.photos(tmp_path / "home")
    assert given.truth and len(given.truth) == len([*given.photos.glob("*.png")])
    assert given.intrinsics == "PINHOLE:320.0,320.0,160.0,120.0" and given.pairs == "exhaustive"
    before = [path.stat().st_mtime_ns for path in given.photos.iterdir()]
    each.photos(tmp_path / "home")
    assert before == [path.stat().st_mtime_ns for path in given.photos.iterdir()]


def test_every_second_photo_of_the_turned_set_shows_the_same_in_the_direction_of_its_pose(tmp_path):
    """The ray through the mark of each photo is that of the photo that was not turned."""
    folder = write_set(tmp_path)
    given = as_turned(folder, tmp_path / "home")
    assert given.intrinsics is None and given.truth is not None
    photos = sorted(given.photos.iterdir())
    assert len(photos) == len(TRUTH)
    for k, (path, true) in enumerate(zip(photos, TRUTH.values(), strict=True)):
        rgb = np.asarray(pycolmap.Bitmap.read(path, True).to_array())
        y, x = np.argwhere(rgb[..., 0] > 128)[0]
        height, width = rgb.shape[:2]
        assert (width, height) == ((24, 32) if k % 2 else (32, 24))
        pose = given.truth[path.name]
        seen = np.asarray([(x + 0.5 - width / 2) / 30, (y + 0.5 - height / 2) / 30, 1])
        ray = np.asarray([(k + 0.5 - 16) / 30, (0.5 - 12) / 30, 1]) @ true.rotation
        np.testing.assert_allclose(seen @ pose.rotation, ray, atol=1e-6)
        np.testing.assert_allclose(pose.centre, true.centre, atol=1e-6)


@pytest.mark.parametrize(
    ("chosen", "part"), [({"first": 4}, slice(4)), ({"every": 2}, slice(None, None, 2))]
)
def test_some_frames_of_a_sequence_have_their_poses(street_sequence, tmp_path, chosen, part):
    given = as_frames(street_sequence, tmp_path, **chosen)
    names = sorted(path.name for path in given.photos.iterdir())
    assert names == sorted(path.name for path in street_sequence.glob("*.png"))[part]
    assert given.truth and sorted(given.truth) == [Path(name).stem for name in names]


def test_a_calibration_is_the_motion_of_points_into_the_camera(tmp_path):
    import h5py

    (tmp_path / "mapping").mkdir()
    (tmp_path / "ground_truth").mkdir()
    assert as_phototourism(tmp_path, tmp_path).truth is None
    pose = TRUTH["01.png"]
    path = tmp_path / "ground_truth" / "calibration_01.h5"
    with h5py.File(path, "w") as file:
        file["R"], file["T"] = pose.rotation, -pose.rotation @ pose.centre
    truth = as_phototourism(tmp_path, tmp_path).truth
    assert truth is not None
    np.testing.assert_allclose(truth["01"].centre, pose.centre)
    path.write_bytes(b"")
    with pytest.raises(UserError, match="calibration_01"):
        as_phototourism(tmp_path, tmp_path)


# -- runs that are there ---------------------------------------------------------------------------


def test_a_finished_run_is_judged_from_its_report_and_its_models(tmp_path):
    write_set(tmp_path)
    right, out = moved(TRUTH, similarity(0)), tmp_path / "out"
    write_run(out / SET / "seed0" / "run", [right])
    write_run(out / SET / "seed1" / "run", [part(right, 0, 5), part(right, 4, 8)], "amber")
    write_rootsift(out, part(right, 0, 6))
    first, second = judged_rows(tmp_path, out)
    assert (first["outcome"], first["verdict"], first["right"]) == ("right", "green", 8)
    assert first["position"] < 1e-5 and first["rotation_deg"] < 1e-4 and first["doubt"] == ""
    assert first["seconds"] == {"matching": 20.0, "mapping": 10.0} and first["times_rootsift"] == 3
    assert first["rootsift"]["registered"] == 6 and first["rootsift"]["position"] < 1e-5
    assert (second["outcome"], second["verdict"], second["right"]) == ("split", "amber", 8)
    assert second["models"] == [5, 4] and second["registered"] == 8 and second["largest"] == 5
    assert second["doubt"].startswith("amber: ") and second["rootsift"] == first["rootsift"]


def test_only_runs_that_have_ended_are_rows_if_none_is_made(tmp_path):
    write_set(tmp_path)
    assert judged_rows(tmp_path, tmp_path / "out", sets=None) == []
    assert not (tmp_path / "out").exists()
    write_run(tmp_path / "out" / SET / "seed1" / "run", [TRUTH])
    assert [row["seed"] for row in judged_rows(tmp_path, tmp_path / "out", sets=None)] == [1]


def test_results_without_a_model_are_no_model_wherever_they_lie(tmp_path):
    write_set(tmp_path)
    write_run(tmp_path / "out" / SET / "seed0" / "run", [])
    write_run(tmp_path / "out" / SET / "seed1" / "run" / "failed", [])
    for row in judged_rows(tmp_path, tmp_path / "out"):
        assert (row["outcome"], row["right"], row["verdict"]) == ("no model", 0, "")
        assert row["total_seconds"] == 30


def test_a_damaged_report_or_model_is_a_row_with_a_sentence(tmp_path):
    write_set(tmp_path)
    for seed in range(2):
        write_run(tmp_path / "out" / SET / f"seed{seed}" / "run", [TRUTH])
    (tmp_path / "out" / SET / "seed0" / "run" / "report.json").write_text("{")
    (tmp_path / "out" / SET / "seed1" / "run" / "sparse" / "0" / "images.bin").write_bytes(b"")
    for row in judged_rows(tmp_path, tmp_path / "out"):
        assert row["outcome"] == "ended in an error" and str(tmp_path / "out") in row["error"]


# -- runs that are made ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_that_raises_or_dies_says_so_in_a_sentence(tmp_path):
    assert apart(os._exit, 7) == "the process ended with exit status 7"
    assert apart(divmod, 1, 0).startswith("ZeroDivisionError: ")
    (tmp_path / "empty").mkdir()
    run = LedgerRun(SetPhotos(tmp_path / "empty"), RunOptions())
    said = run_set(run, tmp_path / "seed0" / "run")
    assert isinstance(said, str) and said.startswith(str(tmp_path / "empty"))


def fake_runs(monkeypatch, fails=()):
    """Runs that leave TRUTH as their model, in this process; returns what was asked for."""
    asked = []

    def fake(work, *args):
        run, folder, *more = args
        asked.append((work.__name__, str(folder.parent.name), run, *more))
        if folder.parent.name in fails:
            return "it failed"
        if work is ledger.run_rootsift:
            write_rootsift(folder.parent.parent.parent, TRUTH)
        else:
            write_run(folder, [TRUTH])
        return ""

    monkeypatch.setattr(ledger, "apart", fake)
    monkeypatch.setattr(ledger_runs, "apart", fake)
    return asked


def test_runs_that_are_missing_are_made_and_the_others_are_not_made_again(tmp_path, monkeypatch):
    write_set(tmp_path)
    asked = fake_runs(monkeypatch)
    rows = judged_rows(tmp_path, tmp_path / "out", only_judge=False)
    assert [row["outcome"] for row in rows] == ["right", "right"]
    made = [("reconstruct_set", "seed0"), ("run_rootsift", "seed0"), ("reconstruct_set", "seed1")]
    assert [each[:2] for each in asked] == made
    assert [each[2].options.seed for each in asked] == [0, 0, 1]
    options = asked[0][2].all_options
    assert options.pairs == "exhaustive" and options.intrinsics == "PINHOLE:30.0,30.0,16.0,12.0"
    assert judged_rows(tmp_path, tmp_path / "out", only_judge=False) == rows and len(asked) == 3


def test_a_run_that_fails_is_a_row_is_tried_again_and_the_ledger_goes_on(tmp_path, monkeypatch):
    write_set(tmp_path)
    fake_runs(monkeypatch, fails=["seed0"])
    for only_judge in (False, True):
        failed, right = judged_rows(tmp_path, tmp_path / "out", only_judge=only_judge)
        assert (failed["outcome"], failed["error"]) == ("ended in an error", "it failed")
        assert right["outcome"] == "right" and right["rootsift"] is None
    fake_runs(monkeypatch)
    rows = judged_rows(tmp_path, tmp_path / "out", only_judge=False)
    assert [row["error"] for row in rows] == ["", ""]


def test_a_step_that_is_left_out_has_folders_of_its_own(tmp_path, monkeypatch):
    write_set(tmp_path)
    asked = fake_runs(monkeypatch)
    out = tmp_path / "out"
    rows = judged_rows(tmp_path, out, only_judge=False, without=("split",), seeds=1)
    assert [row["without"] for row in rows] == ["split"] and rows[0]["times_rootsift"] == 3
    assert [each[1] for each in asked] == ["seed0-without-split", "seed0"]
    assert asked[0][2].all_options.without == ("split",)


def test_a_small_castle_is_small_for_rootsift_too_and_a_rendered_scene_has_none_of_it(
    tmp_path, monkeypatch
):
    write_set(tmp_path, "castle-P19")
    asked = fake_runs(monkeypatch)
    (drawn, *_) = choose_ledger_sets(tmp_path, ["synthetic-*"])
    sets = ("castle-600", drawn.name)
    judged_rows(tmp_path, tmp_path / "out", sets=sets, seeds=1, only_judge=False)
    sizes = [(each[0], each[2].max_size) for each in asked]
    # A rendered scene has no RootSIFT.
    assert sizes == [("reconstruct_set", 600), ("run_rootsift", 600), ("reconstruct_set", None)]


# -- the tables ------------------------------------------------------------------------------------


def row(name="cup", seed=0, outcome="right", **more):
    found = {
        "set": name,
        "kind": "ambiguous",
        "half": "",
        "seed": seed,
        "without": "",
        "wrong": None,
        "images": 10,
        "registered": 10,
        "right": 10,
        "position": 0.01,
        "rotation_deg": 0.5,
        "verdict": "green",
        "outcome": outcome,
        "doubt": "",
        "error": "",
        "seconds": {"mapping": 20.0},
        "total_seconds": 20.0,
        "times_rootsift": 2.0,
    }
    return found | more


def test_the_sums_tell_false_alarms_from_misses():
    rows = [
        row(),
        row(doubt="amber: two", verdict="amber"),
        row(outcome="split", doubt="amber: two", verdict="amber", right=9),
        row(outcome="wrong, not noticed", right=0),
        row(outcome="wrong, noticed", doubt="red: no", verdict="red", right=0),
        row(outcome="ended in an error", verdict="", right=0, times_rootsift=None),
        row(outcome="not judged", right=None, doubt="amber: two", verdict="amber"),
        row(kind="hard"),
    ]
    found, hard = counts(rows)
    assert (found["rows"], found["judged"], found["good"], found["split"]) == (7, 6, 1, 1)
    assert (found["doubted"], found["of_right"]) == (2, 3)
    assert found["missed"] == found["noticed"] == found["errors"] == 1
    assert found["right_share"] == pytest.approx(29 / 60) and found["times_rootsift"] == 2
    # Clopper and Pearson's interval for 2 of 3, from tables.
    assert found["doubted_share"] == pytest.approx((0.0943, 0.9916), abs=1e-4)
    assert hard["kind"] == "hard" and hard["rows"] == 1


def test_seeds_that_differ_are_a_range_and_equal_ones_are_one_figure():
    rows = [row(), row(seed=1, right=8, position=0.02, verdict="amber", total_seconds=31.0)]
    found = set_cells(rows)
    assert (found["right"], found["registered"], found["position"]) == (
        "8-10/10",
        "10/10",
        "0.0100-0.0200",
    )
    assert (found["verdict"], found["seconds"], found["times RootSIFT"]) == (
        "green; amber",
        "20-31",
        "2.0",
    )
    unjudged = set_cells([row(right=None, position=None, times_rootsift=None)])
    assert unjudged["right"] == unjudged["position"] == unjudged["times RootSIFT"] == ""


def test_the_markdown_has_a_line_for_each_set_and_the_commit_in_its_caption():
    rows = [row(), row(seed=1), row("statue", error="it failed"), row("tower", half="choose")]
    figures = {"rows": rows, "summary": counts(rows)}
    text = markdown(figures, "2026-12-01", "abc1234")
    assert text.startswith("**Ledger of 2026-12-01, commit abc1234, 2 seeds.**")
    lines = [line for line in text.splitlines() if line.startswith("| ambiguous | cup")]
    assert len(lines) == 1 and text.count("| statue") == 1
    widths = {line.count("|") for line in text.splitlines()[2:7]}
    assert len(widths) == 1
    assert "commit" not in markdown(figures, "2026-12-01", "")
    assert "statue, seed 0: it failed" in table_lines(figures)


# -- the error rates of the check over its threshold -----------------------------------------------


def checked(outcome, wrong):
    return row(outcome=outcome, wrong=wrong)


def test_right_models_above_the_threshold_are_false_alarms_and_wrong_ones_below_it_misses():
    rows = [checked("right", 0.04), checked("split", 0.4), checked("wrong, noticed", 0.25)]
    rows += [
        checked("wrong, not noticed", 0.0),
        checked("no model", None),
        checked("not judged", 0.9),
    ]
    found = {each.threshold: each for each in error_curve(rows)}
    assert found[0.02][1:] == (2, 2, 1, 2)
    assert found[0.2][1:] == (1, 2, 1, 2)
    assert found[0.3][1:] == (1, 2, 2, 2)
    assert found[0.5][1:] == (0, 2, 2, 2)


def test_with_the_threshold_false_alarms_fall_and_misses_grow():
    rows = [checked("right", k / 10) for k in range(10)] + [
        checked("wrong, noticed", k / 10) for k in (2, 8)
    ]
    curve = error_curve(rows)
    assert [each.threshold for each in curve] == sorted(THRESHOLDS)
    for before, after in zip(curve, curve[1:], strict=False):
        assert after.false_alarms <= before.false_alarms and after.misses >= before.misses


# -- the command -----------------------------------------------------------------------------------


def test_the_command_writes_its_tables(tmp_path, capsys):
    write_set(tmp_path)
    write_run(tmp_path / "out" / SET / "seed0" / "run", [TRUTH])
    args = ["--out", str(tmp_path / "out"), "--json", str(tmp_path / "ledger.json")]
    args += ["--markdown", str(tmp_path / "ledger.md"), "--only-judge"]
    assert main(["bench", "ledger", "--root", str(tmp_path), *args]) == 0
    assert "right, whole, green" in capsys.readouterr().out
    (found,) = json.loads((tmp_path / "ledger.json").read_text())["rows"]
    assert found["set"] == SET and found["half"] == ""
    assert f"| ordinary | {SET} | 8/8 | 8/8 |" in (tmp_path / "ledger.md").read_text()


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["--root", "/nowhere"], "no such folder"),
        (["--sets", "room"], "no set 'room'"),
        (["--sets", ""], "--sets: none given"),
        (["--seeds", "0"], "--seeds"),
        (["--threads", "0"], "--threads"),
        (["--only-judge"], "--only-judge needs --out"),
        (["--markdown", "ledger.txt"], "--markdown"),
    ],
)
def test_what_cannot_be_done_is_said(tmp_path, capsys, args, word):
    root = [] if "--root" in args else ["--root", str(tmp_path)]
    assert main(["bench", "ledger", *root, *args]) == 2
    error = capsys.readouterr().err
    assert word in error and "Traceback" not in error
