"""Laws of the judgement of a collection's models beside rough reference poses."""

import json

import numpy as np
import pytest

from jaxsfm.bench import collection
from jaxsfm.bench.collection import LARGE, Made, cells, differences, model_figures, right_photos
from jaxsfm.bench.rendered_video import turned
from jaxsfm.cli.main import main
from jaxsfm.colmap.poses import CameraPose


def ring(count: int) -> dict[str, CameraPose]:
    """Cameras on a circle that look at its middle."""
    found = {}
    for k in range(count):
        turn = turned(np.asarray([0, 360 * k / count, 0]))
        found[f"{k:02d}.jpg"] = CameraPose(turn, turn.T @ np.asarray([0, 0, -5.0]))
    return found


def moved(poses, degrees: float) -> dict[str, CameraPose]:
    """The same cameras in a world that is turned, and twice as large."""
    turn = turned(np.asarray([0, degrees, 0]))
    return {n: CameraPose(p.rotation @ turn.T, 2 * turn @ p.centre) for n, p in poses.items()}


class Model:
    """What is asked of a model besides its poses."""

    points3D = (1, 2, 3)

    def __init__(self, poses):
        self.poses = poses

    def compute_mean_reprojection_error(self) -> float:
        return 0.5


@pytest.fixture(autouse=True)
def poses_of_models(monkeypatch):
    monkeypatch.setattr(collection, "model_poses", lambda model: model.poses)


def test_a_world_that_is_turned_and_scaled_is_right_as_a_whole():
    truth = ring(12)
    figures = model_figures(Model(moved(truth, 70.0)), truth)
    assert figures["right"] == sorted(truth)
    assert figures["pairs_right"] == figures["neighbours_right"] == 1.0


def test_of_two_groups_that_are_turned_against_each_other_the_larger_one_is_right():
    truth = ring(12)
    names = sorted(truth)
    model = moved({n: truth[n] for n in names[:7]}, 70.0)
    model |= moved({n: truth[n] for n in names[7:]}, 160.0)
    figures = model_figures(Model(model), truth)
    assert figures["right"] == names[:7]
    assert figures["pairs_right"] == pytest.approx((7 * 6 + 5 * 4) / (12 * 11))
    assert 0 < figures["neighbours_right"] < 1


@pytest.mark.parametrize(("degrees", "right"), [(9.0, 12), (11.0, 11)])
def test_a_photo_is_right_within_ten_degrees(degrees, right):
    truth = ring(12)
    off = moved({"05.jpg": truth["05.jpg"]}, 70.0 + degrees)
    assert len(right_photos(*differences(moved(truth, 70.0) | off, truth))) == right


def test_neighbours_are_judged_within_five_degrees():
    truth = ring(12)
    shares = [
        model_figures(Model(truth | moved({"05.jpg": truth["05.jpg"]}, d)), truth) for d in (4, 7)
    ]
    assert shares[0]["neighbours_right"] == 1 > shares[1]["neighbours_right"]
    assert shares[1]["pairs_right"] == 1


def test_photos_without_a_reference_are_registered_and_not_judged():
    truth = ring(12)
    model = truth | {"strange.jpg": truth["00.jpg"], "another.jpg": truth["01.jpg"]}
    row = collection._row("default", 20, Made([Model(model)], {}, None), truth)
    assert (row["photos"], row["registered"], row["right_in_large"]) == (20, 14, 12)
    assert row["models"][0]["photos"] == 14 and cells(row)["registered"] == "14 of 20"
    assert right_photos(*differences({}, truth)) == []
    few = {name: truth["00.jpg"] for name in ("a.jpg", "b.jpg", "c.jpg")} | {
        "00.jpg": truth["00.jpg"]
    }
    assert collection._row("default", 20, Made([Model(few)], {}, None), truth)["small_models"] == 1


def test_only_large_models_count_and_a_photo_counts_once():
    truth = ring(30)
    names = sorted(truth)
    parts = [names[:LARGE], names[LARGE - 1 : 2 * LARGE - 1], names[20:25], names[28:]]
    models = [Model({n: truth[n] for n in part}) for part in parts]
    row = collection._row("default", 31, Made(models, {"mapping": 2.0}, "amber"), truth)
    assert row["right_in_large"] == 2 * LARGE - 1
    assert row["registered"] == len(set().union(*parts))
    assert [model["photos"] for model in row["models"]] == [LARGE, LARGE, 5]
    shown = cells(row)
    assert shown["models"] == "10 of 10, 10 of 10" and shown["smaller"] == "2"


def test_rootsift_needs_a_preset_which_chooses_the_pairs(tmp_path, capsys):
    both = ["--root", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(["bench", "collection", *both, "--methods", "rootsift"]) == 2
    assert "rootsift needs a preset beside it" in capsys.readouterr().err


@pytest.mark.parametrize("extend", ["1", "-2"])
def test_each_second_photo_or_fewer_can_be_kept_out(extend, tmp_path, capsys):
    both = ["--root", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(["bench", "collection", *both, "--extend", extend]) == 2
    assert f"--extend must be 0, or at least 2; got {extend}" in capsys.readouterr().err


@pytest.mark.slow
def test_a_street_is_right_beside_rootsift_on_the_same_pairs(street, tmp_path, monkeypatch):
    monkeypatch.undo()
    figures = tmp_path / "figures.json"
    given = ["--root", str(street / "images"), "--reference", str(street / "reference")]
    end = ["--out", str(tmp_path / "out"), "--json", str(figures)]
    assert main(["bench", "collection", *given, *end]) == 0
    ours, theirs = json.loads(figures.read_text())["rows"]
    assert (ours["method"], theirs["method"]) == ("default", "rootsift")
    assert ours["registered"] == ours["right_in_large"] == ours["photos"] == 11
    assert ours["verdict"] in ("green", "amber") and theirs["verdict"] is None
    assert theirs["registered"] >= 3


@pytest.mark.slow
def test_photos_that_were_kept_out_are_added_and_judged(street, tmp_path, monkeypatch):
    monkeypatch.undo()
    figures = tmp_path / "figures.json"
    given = ["--root", str(street / "images"), "--reference", str(street / "reference")]
    end = ["--methods", "default", "--extend", "4", "--out", str(tmp_path), "--json", str(figures)]
    assert main(["bench", "collection", *given, *end]) == 0
    row = json.loads(figures.read_text())["rows"][0]
    assert row["photos"] == row["registered"] == 8
    assert (row["extension"]["photos"], row["extension"]["placed"]) == (3, 3)
    kept_out = sorted(path.name for path in (street / "images").iterdir())[2::4]
    assert row["extension"]["right"] == kept_out
    assert cells(row)["added"].startswith("3 of 3 of 3, ")
