"""`bench poses`: the files of pairs, the error of a pose, and a run on a rendered pair."""

import json

import cv2
import numpy as np
import pytest
from strategies import rng_of

from jaxsfm.bench.matches import Matches
from jaxsfm.bench.poses import (
    PosedPair,
    RelativePose,
    areas,
    estimated_pose,
    pose_error_deg,
    read_pairs,
)
from jaxsfm.cli.main import main
from jaxsfm.colmap.poses import read_poses
from jaxsfm.errors import UserError

K = np.asarray([[600.0, 0, 320], [0, 590, 240], [0, 0, 1]])


def turned(axis, degrees):
    axis = np.asarray(axis, np.float64)
    return cv2.Rodrigues(axis / np.linalg.norm(axis) * np.radians(degrees))[0]


def test_the_error_is_the_larger_angle_of_rotation_and_direction():
    truth = RelativePose(turned([1, 2, 3], 20), np.asarray([1.0, 0, 0]))
    for angle in (0.0, 3.0, 90.0, 180.0):
        found = RelativePose(turned([0, 1, 0], angle) @ truth.rotation, truth.translation * 7)
        assert pose_error_deg(found, truth) == pytest.approx(angle, abs=1e-5)
    for angle, expected in ((3.0, 3.0), (180.0, 0.0), (120.0, 60.0)):
        moved = turned([0, 0, 1], angle) @ truth.translation
        assert pose_error_deg(truth._replace(translation=moved), truth) == pytest.approx(
            expected, abs=1e-5
        )
    assert pose_error_deg(None, truth) == np.inf


@pytest.mark.parametrize("seed", range(3))
def test_exact_matches_give_the_pose_and_few_give_none(seed):
    rng = rng_of(seed)
    truth = RelativePose(turned(rng.normal(size=3), 15), rng.normal(size=3))
    points = rng.uniform([-2, -2, 4], [2, 2, 9], size=(80, 3))
    x0, x1 = points @ K.T, (points @ truth.rotation.T + truth.translation) @ K.T
    xy0, xy1 = x0[:, :2] / x0[:, 2:], x1[:, :2] / x1[:, 2:]
    xy1[:20] += rng.uniform(30, 90, (20, 2))  # wrong ones
    pair = PosedPair((None, None), (K, K), truth)  # pyright: ignore[reportArgumentType]
    found = estimated_pose(Matches(xy0, xy1, 0.0), pair, seed=0)
    assert pose_error_deg(found, truth) < 0.1
    again = estimated_pose(Matches(xy0, xy1, 0.0), pair, seed=0)
    assert found is not None and again is not None
    np.testing.assert_array_equal(found.rotation, again.rotation)
    assert estimated_pose(Matches(xy0[:4], xy1[:4], 0.0), pair, seed=0) is None


def test_areas_are_over_all_pairs_and_seeds():
    rows = [
        {"method": "a", "errors_deg": errors} for errors in ([0.0, 2.5], [None, 40.0])
    ]  # of 5 deg: 1, 1/2, 0, 0
    found = areas(rows)["a"]
    assert found["5"] == pytest.approx(1.5 / 4) and found["10"] == pytest.approx(1.75 / 4)


@pytest.fixture
def pair(scene):
    """The names of two views, K, and the pose of the second one in the first."""
    poses = read_poses(scene / "reference")
    names = sorted(name for name in poses if "night" not in name)[:2]
    a, b = (poses[name] for name in names)
    rotation = b.rotation @ a.rotation.T
    return names, np.loadtxt(scene / "K.txt"), rotation, b.rotation @ (a.centre - b.centre)


def row(pair, form: str) -> str:
    names, k, rotation, translation = pair
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    pose = [*rotation.flat, *translation] if form == "rt" else [*matrix.flat]
    turns = ["0", "0"] if form == "superglue" else []
    return " ".join([*names, *turns, *map(str, [*k.flat, *k.flat, *pose])])


@pytest.mark.parametrize("form", ["rt", "matrix", "superglue"])
def test_all_layouts_give_the_same_pair(scene, pair, tmp_path, form):
    file = tmp_path / "pairs.txt"
    file.write_text(f"\n{row(pair, form)}\n")
    (read,) = read_pairs(file, scene / "images")
    names, k, rotation, translation = pair
    assert [image.name for image in read.images] == names
    for camera in read.cameras:
        np.testing.assert_allclose(camera, k)
    np.testing.assert_allclose(read.truth.rotation, rotation)
    np.testing.assert_allclose(read.truth.translation, translation)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda text: "", "no pairs"),
        (lambda text: text + " 1", "row 1: expected"),
        (lambda text: text.replace(" 0 0 ", " 0 1 ", 1), "row 1: photos that are turned"),
        (lambda text: text.replace("view", "gone", 1), "gone0.png"),
        (lambda text: text.rsplit(" ", 1)[0] + " x", "row 1: a word"),
        (lambda text: text.replace(" 1.0", " 2.0", 1), "row 1: no camera matrix"),
        (lambda text: text.removesuffix("0.0 0.0 0.0 1.0") + "0 0 0 1", None),
        (lambda text: " ".join([*text.split(" ")[:22], *["0"] * 16]), "row 1: no rotation"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(scene, pair, tmp_path, change, word):
    file = tmp_path / "pairs.txt"
    file.write_text(change(row(pair, "superglue")))
    if word is None:  # nothing is wrong
        assert len(read_pairs(file, scene / "images")) == 1
        return
    with pytest.raises(UserError, match=word):
        read_pairs(file, scene / "images")


def test_a_rendered_pair_has_a_small_error(scene, pair, tmp_path, capsys):
    file, out = tmp_path / "pairs.txt", tmp_path / "figures.json"
    file.write_text(f"{row(pair, 'rt')}\n" * 2)
    args = ["--root", str(scene / "images"), "--pairs", str(file), "--methods", "rootsift"]
    assert main(["bench", "poses", *args, "--every", "2", "--json", str(out)]) == 0
    figures = json.loads(out.read_text())
    (found,) = figures["rows"]
    assert found["errors_deg"][0] < 3 and figures["summary"]["rootsift"]["10"] > 0.7
    assert "AUC 20" in capsys.readouterr().out
    assert main(["bench", "poses", *args, "--every", "0"]) == 2
    assert "--every" in capsys.readouterr().err
