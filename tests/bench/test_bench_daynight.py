"""`bench daynight`: scenes in every layout, the protocol's figures, a run on the rendered room."""

import dataclasses
import json
import re
import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsfm.bench import scenes
from jaxsfm.bench.daynight import PUBLISHED, cumulative, table_lines
from jaxsfm.bench.model_options import DayNightOptions
from jaxsfm.bench.night_protocol import LIMITS, judge, summary
from jaxsfm.bench.scenes import Subset
from jaxsfm.bench.subset_models import (
    NightMatches,
    SubsetModel,
    dense_models,
    epipolar_distance,
    naive_models,
    rootsift_models,
)
from jaxsfm.cli.main import main
from jaxsfm.colmap.poses import CameraPose, read_poses
from jaxsfm.errors import UserError


def test_every_image_of_a_strecha_set_is_the_night_once(strecha, tmp_path):
    options = DayNightOptions(root=strecha, severity=1)
    made = scenes.synthetic_scene(strecha / "room", tmp_path / "a", options)
    day = sorted(name for name in made.images if not name.startswith("night/"))
    assert len(made.subsets) == len(day) == 3 and len(made.images) == 6 and made.synthetic
    for subset in made.subsets:
        own = next(n for n in day if subset.night == f"night/{n.rpartition('.')[0]}.png")
        assert subset.day == [name for name in day if name != own]
        assert made.truth[subset.night] is made.truth[own]
    again = scenes.synthetic_scene(strecha / "room", tmp_path / "b", options)
    assert {n: i.sha256 for n, i in made.images.items()} == {
        n: i.sha256 for n, i in again.images.items()
    }


def test_the_simple_layout(simple):
    made = scenes.simple_scene(simple / "room")
    assert len(made.subsets) == 1 and len(made.subsets[0].day) == 4 and not made.synthetic
    assert set(made.truth) == set(made.images) and made.camera.model == "PINHOLE"
    poses = read_poses(simple / "room" / "reference")
    night = made.subsets[0].night
    assert np.array_equal(made.truth[night].centre, poses[night.rpartition("/")[2]].centre)


def test_photos_are_found_in_the_reference_without_suffix(simple, tmp_path):
    shutil.copytree(simple / "room", tmp_path / "room")
    for path in (tmp_path / "room" / "reference").iterdir():
        path.rename(path.with_name(path.name.replace(".png", ".jpg")))
    made = scenes.simple_scene(tmp_path / "room")
    assert set(made.truth) == set(made.images)


def test_a_day_and_a_night_photo_of_one_name_do_not_share_a_pose(simple, tmp_path):
    shutil.copytree(simple / "room", tmp_path / "room")
    day = min((tmp_path / "room" / "day").iterdir())
    shutil.copy(day, tmp_path / "room" / "night" / day.name)
    made = scenes.simple_scene(tmp_path / "room")
    assert not {f"day/{day.name}", f"night/{day.name}"} & set(made.truth)


@pytest.mark.parametrize(
    ("damage", "word"),
    [
        ("empty camera", "intrinsics.txt"),
        ("odd camera", "intrinsics.txt"),
        ("binary camera", "intrinsics.txt"),
        ("other size", "differ in size"),
        ("reference", "fewer than 3"),
        ("no day", "no images"),
        ("photo", "view0.png"),
    ],
)
def test_damaged_scenes_are_named_before_the_first_run(simple, tmp_path, capsys, damage, word):
    room = tmp_path / "room"
    shutil.copytree(simple / "room", room)
    if damage.endswith("camera"):
        text = {"empty": b"", "odd": b"PINHOLE:1,2", "binary": bytes(range(128, 256))}
        (room / "intrinsics.txt").write_bytes(text[damage.partition(" ")[0]])
    elif damage == "other size":
        cv2.imwrite(str(room / "night" / "x.png"), np.zeros((100, 100, 3), np.uint8))
    elif damage == "reference":
        for path in list((room / "reference").iterdir())[2:]:
            path.unlink()
    elif damage == "no day":
        shutil.rmtree(room / "day")
        (room / "day").mkdir()
    else:
        (room / "day" / "view0.png").write_bytes(b"no image")
    assert main(["bench", "daynight", "--root", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert word in said.err and "Traceback" not in said.err and "rootsift" not in said.out


@pytest.mark.slow
def test_a_subset_is_made_of_its_own_photos_alone(scene, simple, tmp_path, monkeypatch):
    """Two nights: neither reconstruction may hold the other's night photo."""
    room = tmp_path / "room"
    shutil.copytree(simple / "room", room)
    night = next((room / "night").iterdir())
    shutil.copy(night, room / "night" / "again.png")
    made = scenes.simple_scene(room)
    assert len(made.subsets) == 2
    options = DayNightOptions(root=tmp_path, threads=1)
    for runs in (
        rootsift_models(made, tmp_path, options),
        dense_models(made, tmp_path, "paper", options),
        naive_models(made, tmp_path, options),
    ):
        for (poses, matches), subset in zip(runs, made.subsets, strict=True):
            assert subset.night in poses and set(poses) <= {*subset.day, subset.night}
            assert (matches is None) == (subset.night not in made.truth)
            assert matches is None or 0.5 * matches.number < matches.correct <= matches.number


@pytest.mark.slow
def test_a_subset_without_a_model_and_one_of_other_photos_leave_nothing_to_the_next(
    simple, tmp_path
):
    """The first subset has three unlike photos; the next ones have none of them."""
    room = tmp_path / "room"
    shutil.copytree(simple / "room", room)
    made = scenes.simple_scene(room)
    night = made.subsets[0].night
    noise = np.random.default_rng(0).integers(0, 255, (3, 240, 320, 3), np.uint8)
    for name, pixels in zip(("n0.png", "n1.png", "n2.png"), noise, strict=True):
        cv2.imwrite(str(room / name), pixels)
        made.images[name] = dataclasses.replace(made.images[night], name=name, path=room / name)
        made.truth[name] = made.truth[night]
    odd = Subset(["n0.png", "n1.png"], "n2.png")
    made = made._replace(subsets=[odd, made.subsets[0], odd])
    options = DayNightOptions(root=tmp_path, threads=1)
    first, second, third = dense_models(made, tmp_path, "paper", options)
    assert first.poses == third.poses == {} and first.matches.correct == 0
    assert night in second.poses and second.matches.correct > 0
    assert not list(tmp_path.rglob("features"))


@pytest.mark.slow
def test_a_photo_that_cannot_be_decoded_is_one_sentence(simple, tmp_path):
    room = tmp_path / "room"
    shutil.copytree(simple / "room", room)
    made = scenes.simple_scene(room)
    path = room / made.subsets[0].night
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(UserError, match=path.name):
        dense_models(made, tmp_path, "paper", DayNightOptions(root=tmp_path, threads=1))


def poses_on_arc(names):
    return {
        name: CameraPose(np.eye(3), np.asarray([k, 0.3 * k * k, 0.1 * k]))
        for k, name in enumerate(names)
    }


def test_the_night_camera_is_judged_after_a_similarity_from_the_day():
    names = ["a", "b", "c", "d", "n"]
    truth = poses_on_arc(names)
    turned = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    truth["n"] = CameraPose(turned, truth["n"].centre)
    moved = {name: CameraPose(pose.rotation, 3 * pose.centre + 5) for name, pose in truth.items()}
    moved["n"] = CameraPose(moved["n"].rotation, moved["n"].centre + [0.6, 0, 0])
    subset = Subset(names[:4], "n")
    row = judge(SubsetModel(moved, None), subset, truth)
    assert row["registered"] and row["day_registered"] == 4
    assert row["position"] == pytest.approx(0.2) and row["rotation_deg"] < 1e-6
    w, x, y, z, *t = row["pose"]  # from the world of the reference to the camera
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(rotation, truth["n"].rotation, atol=1e-9)
    np.testing.assert_allclose(-rotation.T @ t, truth["n"].centre + [0.2, 0, 0], atol=1e-9)
    del moved["n"]
    assert "position" not in judge(SubsetModel(moved, None), subset, truth)
    lonely = {name: truth[name] for name in ("a", "n")}
    row = judge(SubsetModel(lonely, None), subset, truth)
    assert row["registered"] and "not_evaluated" in row and row["day_registered"] == 1
    assert judge(SubsetModel({}, NightMatches(9, 4)), subset, truth) == {
        "night": "n",
        "registered": False,
        "has_truth": True,
        "day_registered": 0,
        "day_images": 4,
        "matches": 9,
        "correct": 4,
    }


def test_the_distance_from_the_epipolar_line_is_that_of_the_image():
    rng = np.random.default_rng(0)
    focal, poses = 800.0, []
    for _ in range(2):
        turn = cv2.Rodrigues(rng.normal(size=3) * 0.2)[0]
        poses.append(CameraPose(turn, rng.normal(size=3)))
    points = rng.normal(size=(50, 3)) + [0, 0, 12]
    rays = [(points - pose.centre) @ pose.rotation.T for pose in poses]
    assert np.abs(epipolar_distance(*rays, *poses)).max() < 1e-12
    # A second point on the same ray of image 0 spans the line; step off it by 3 px.
    along = [(points + 0.1 * (points - poses[0].centre)) - pose.centre for pose in poses][1]
    along = along @ poses[1].rotation.T
    at, other = (x[:, :2] / x[:, 2:] for x in (rays[1], along))
    normal = (other - at)[:, ::-1] * [1, -1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    moved = np.c_[at + 3 / focal * normal, np.ones(50)]
    np.testing.assert_allclose(focal * epipolar_distance(rays[0], moved, *poses), 3.0, rtol=1e-6)


def test_unregistered_nights_count_in_the_shares():
    base = {"day_registered": 3, "day_images": 4, "has_truth": True}
    rows = [
        base | {"registered": True, "position": 0.05, "rotation_deg": 0.5},
        base | {"registered": True, "position": 0.05, "rotation_deg": 20.0},
        base | {"registered": True, "not_evaluated": "on one line"},
        base | {"registered": False},
    ]
    got = summary(rows)
    assert got["nights"] == 4 and got["night_registered"] == 3
    assert (got["day_registered"], got["day_images"]) == (12, 16)
    assert got["within"]["0.1; 1 deg"] == 0.25 == got["within"]["20; 10 deg"]
    assert got["sorted_positions"] == [0.05, 0.05] and got["sorted_rotations_deg"] == [0.5, 20.0]
    assert got["nights_with_reference"] == 4
    assert got["not_evaluated"] == 1 and got["correct"] is None
    counts = [{"matches": 5, "correct": 2}, {"matches": 3, "correct": 3}, {}, {}]
    counted = summary([row | count for row, count in zip(rows, counts, strict=True)])
    assert (counted["matches"], counted["correct"]) == (8, 5)
    unknown = {"registered": True, "has_truth": False, "day_registered": 3, "day_images": 4}
    assert summary([*rows, unknown])["within"] == got["within"]
    assert summary([unknown])["within"] is None and summary([])["within"] is None


@pytest.mark.parametrize("seed", range(3))
def test_a_cumulative_curve_counts_the_errors_up_to_x(seed):
    """Against counting, at points between the errors; nights without an error count as well."""
    rng = np.random.default_rng(seed)
    errors, number = rng.exponential(size=20), 30
    x, y = cumulative(errors, number)
    for limit in rng.exponential(size=50):
        reached = y[np.searchsorted(x, limit, side="right") - 1]
        assert reached == pytest.approx(sum(error <= limit for error in errors) / number)
    assert y[0] == 0 and y[-1] == pytest.approx(20 / 30)
    with pytest.raises(ValueError, match="number must be at least 20"):
        cumulative(errors, 19)


def test_the_papers_rows_are_in_the_table_under_the_same_limits():
    got = summary([])
    lines = table_lines({"rows": [], "summary": {"paper": got}})
    heads = lines[0]
    for (method, (night, day, within)), line in zip(PUBLISHED.items(), lines[-3:], strict=True):
        assert method in line and f"{night}/98" in line and f"{day}/1960" in line
        for limit, percent in zip(LIMITS[1:], within, strict=True):
            head = f"{limit[0]:g}; {limit[1]:g} deg"
            end = re.search(rf"(?<!\S){re.escape(head)}", heads).end()
            assert line[:end].endswith(f" {percent:.0f}%")


@pytest.mark.slow
def test_methods_run_side_by_side_on_a_scene(simple, tmp_path, capsys):
    out = tmp_path / "figures.json"
    methods = ("rootsift", "paper-grid", "paper", "default")  # and robust, in four times the time
    asked = DayNightOptions(root=simple)
    assert asked.chosen_methods([*methods, "robust"]) == [*methods, "robust"]
    args = ["bench", "daynight", "--root", str(simple), "--json", str(out), "--threads", "1"]
    args += ["--methods", ",".join(methods)]
    assert main([*args, "--curves", str(tmp_path / "curves.png")]) == 0
    assert cv2.imread(str(tmp_path / "curves.png")).std() > 5
    figures = json.loads(out.read_text())
    rows = {row["method"]: row for row in figures["rows"]}
    assert tuple(rows) == methods
    for row in rows.values():
        assert row["nights"] == 1 and row["day_images"] == 4 and not row["synthetic"]
    for method in ("paper", "default"):
        assert rows[method]["night_registered"] == 1 and rows[method]["day_registered"] == 4
        assert rows[method]["within"]["0.5; 10 deg"] == 1
    assert rows["default"]["within"]["0.1; 1 deg"] == 1
    assert rows["default"]["correct"] > 0.5 * rows["default"]["matches"] > 50
    assert "published" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["--root", "/nowhere"], "no such folder"),
        (["--root", "{root}", "--methods", "paper", "--weights", "/nowhere"], "/nowhere: cannot"),
        (["--root", "{root}/room/day"], "no scenes"),
        (["--root", "{root}", "--seed", "-1"], "--seed"),
        (["--root", "{root}", "--seed", "3000000000"], "--seed"),
        (["--root", "{root}", "--threads", "0"], "--threads"),
        (["--root", "{root}", "--sets", ","], "--sets"),
        (["--root", "{root}", "--sets", "hall"], "no set 'hall'"),
        (["--root", "{root}", "--severity", "-1"], "--severity"),
        (["--root", "{root}", "--subsets", "list.txt"], "Aachen"),
        (["--root", "{root}", "--poses", "/nowhere"], "--poses"),
        (["--root", "{root}", "--curves", "curves.svg"], "--curves"),
        (["--root", "{root}", "--methods", "orb"], "no method 'orb'"),
    ],
)
def test_what_cannot_be_run_is_said(simple, capsys, args, word):
    assert main(["bench", "daynight", *(a.format(root=simple) for a in args)]) == 2
    error = capsys.readouterr().err
    assert word in error and "Traceback" not in error
