"""`bench wxbs`: the measure's laws, and a run on a rendered pair."""

import dataclasses
import itertools
import json
import shutil

import numpy as np
import pytest
from epipolar import two_views
from strategies import rng_of

from jaxsfm.bench.methods import CONFIGS, METHODS, method_config
from jaxsfm.bench.wxbs import (
    PUBLISHED_THRESHOLDS_PX,
    WxbsOptions,
    half_of,
    mean_average_accuracy,
    means,
    symmetric_epipolar_error,
)
from jaxsfm.cli.main import main
from jaxsfm.colmap.poses import read_poses
from jaxsfm.config import PRESETS, preset


@pytest.mark.parametrize("seed", range(5))
def test_epipolar_error_is_the_distance_to_both_lines(seed):
    rng = rng_of(seed)
    f, xy0, xy1 = two_views(rng)
    assert symmetric_epipolar_error(f, xy0, xy1).max() < 1e-6
    off = xy1 + rng.normal(size=xy1.shape) * 5
    got = symmetric_epipolar_error(f, xy0, off)
    for a, b, error in zip(xy0, off, got, strict=True):
        distances = []
        for line, point in ((f @ [*a, 1], b), (f.T @ [*b, 1], a)):
            distances.append(abs(line @ [*point, 1]) / np.hypot(line[0], line[1]))
        assert error == pytest.approx(np.hypot(*distances))
    swapped = symmetric_epipolar_error(f.T, off, xy0)
    np.testing.assert_allclose(swapped, got)


def test_an_undefined_line_counts_as_far_away():
    assert (
        symmetric_epipolar_error(np.zeros((3, 3)), np.ones((2, 2)), np.ones((2, 2))).min() == np.inf
    )


def test_mean_average_accuracy_counts_whole_pixels():
    assert mean_average_accuracy(np.zeros(4)) == 1
    assert mean_average_accuracy(np.full(4, np.inf)) == 0
    assert mean_average_accuracy(np.asarray([10.5])) == 0.5  # within 11 .. 20 px
    assert mean_average_accuracy(np.asarray([1.0, 20.1])) == 0.5


def test_published_limits_are_those_up_to_ten_pixels():
    limits = PUBLISHED_THRESHOLDS_PX
    assert mean_average_accuracy(np.zeros(4), limits) == 1
    assert mean_average_accuracy(np.asarray([0.5, 10.5]), limits) == pytest.approx(10 / 22)


def test_a_pair_is_in_the_same_half_wherever_it_is_run():
    """The hash is of the name alone, so a figure of one half can be repeated by others."""
    assert half_of("WGBS/kn-church") == "half A" and half_of("WGALBS/tyn") == "half B"


def test_means_average_pairs_before_seeds():
    rows = [
        {"category": c, "method": "paper", "scores": s, "half": h}
        for c, s, h in (
            ("A", [0.0, 1.0], "half A"),
            ("A", [1.0, 0.0], "half B"),
            ("B", [0.2, 0.4], "half B"),
        )
    ]
    got = means(rows)["paper"]
    assert got["A"] == {"mean": 0.5, "min": 0.5, "max": 0.5}
    assert got["B"]["min"] == 0.2 and set(got) == {"A", "B", "half A", "half B", "all"}
    assert got["half A"] == {"mean": 0.5, "min": 0.0, "max": 1.0}
    assert got["all"]["mean"] == pytest.approx((1 + 1 + 0.6) / 6)


@pytest.fixture(scope="module")
def root(scene, tmp_path_factory):
    """CATEGORY/NAME with two views of the room; marked points on exact epipolar lines."""
    folder = tmp_path_factory.mktemp("wxbs")
    pair = folder / "WG" / "room"
    pair.mkdir(parents=True)
    names = sorted(path.name for path in (scene / "images").glob("view*"))
    for name, target in zip((names[0], names[2]), ("01.png", "02.png"), strict=True):
        shutil.copy(scene / "images" / name, pair / target)
    poses = read_poses(scene / "reference")
    a, b = (poses[name] for name in (names[0], names[2]))
    k = np.loadtxt(scene / "K.txt")
    rotation = b.rotation @ a.rotation.T
    t = b.rotation @ (a.centre - b.centre)
    f = np.linalg.inv(k).T @ np.cross(np.eye(3), t).T @ rotation @ np.linalg.inv(k)
    rng, rows = rng_of(0), []
    for _ in range(20):
        x0 = rng.uniform([40, 40], [280, 200])
        line = f @ [*x0, 1]
        x = rng.uniform(40, 280)
        rows.append([*x0, x, -(line[0] * x + line[2]) / line[1]])
    np.savetxt(pair / "corrs.txt", rows)
    return folder


@pytest.mark.slow
def test_a_rendered_pair_scores_well_and_repeats(root, tmp_path, capsys):
    out = tmp_path / "figures.json"
    args = ["bench", "wxbs", "--root", str(root), "--json", str(out)]
    args += ["--methods", "rootsift,paper,default"]  # and robust, in four times the time
    assert main([*args, "--seeds", "2"]) == 0
    figures = json.loads(out.read_text())
    assert main([*args, "--seeds", "1"]) == 0
    rows, again = (
        {row["method"]: row for row in given["rows"]}
        for given in (figures, json.loads(out.read_text()))
    )
    assert set(rows) == {"rootsift", "paper", "default"}
    for method in rows:
        assert len(rows[method]["scores"]) == 2
        assert rows[method]["scores"][:1] == again[method]["scores"]
    assert rows["paper"]["maa"]["min"] > 0.6 < rows["default"]["maa"]["min"]
    text = capsys.readouterr().out
    assert "WG/room" in text and "mean of all" in text and "published" not in text
    assert figures["summary"]["paper"]["WG"] == figures["summary"]["paper"]["all"]


@pytest.mark.slow
def test_the_published_protocol_is_run_beside_published_figures(root, tmp_path, capsys):
    out = tmp_path / "figures.json"
    args = ["--root", str(root), "--methods", "rootsift", "--seeds", "1", "--protocol", "lo"]
    assert main(["bench", "wxbs", *args, "--json", str(out)]) == 0
    (row,) = json.loads(out.read_text())["rows"]
    assert row["maa"]["mean"] > 0.5 and row["significance"] is None
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[-2:] == ["published, all pairs DKM 0.589", "published, all pairs RoMa 0.801"]


def test_categories_and_pairs_are_chosen_by_name(root, tmp_path, capsys):
    for chosen in ("WG", "WG/room"):
        args = ["--root", str(root), "--sets", chosen, "--methods", "rootsift", "--seeds", "1"]
        assert main(["bench", "wxbs", *args]) == 0
        assert "WG/room" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["--root", "/nowhere"], "no such folder"),
        (["--root", "{root}", "--methods", "paper", "--weights", "/nowhere"], "/nowhere: cannot"),
        (["--root", "{root}/WG"], "no pairs"),
        (["--root", "{root}", "--sets", "WL"], "no set 'WL'"),
        (["--root", "{root}", "--methods", "orb"], "no method 'orb'"),
        (["--root", "{root}", "--seeds", "0"], "--seeds"),
        (["--root", "{root}", "--max-size", "3"], "--max-size"),
        (["--root", "{root}", "--methods", ""], "--methods"),
    ],
)
def test_what_cannot_be_run_is_said(root, capsys, args, word):
    assert main(["bench", "wxbs", *(a.format(root=root) for a in args)]) == 2
    error = capsys.readouterr().err
    assert word in error and "Traceback" not in error


@pytest.mark.parametrize("damage", ["points", "image", "broken"])
def test_damaged_inputs_are_named_before_the_first_run(root, tmp_path, capsys, damage):
    shutil.copytree(root, tmp_path / "w")
    pair = tmp_path / "w" / "WG" / "room"
    if damage == "points":
        (pair / "corrs.txt").write_text("1 2 3\n")
    elif damage == "image":
        (pair / "02.png").unlink()
    else:
        (pair / "02.png").write_bytes(b"no image")
    assert main(["bench", "wxbs", "--root", str(tmp_path / "w")]) == 2
    said = capsys.readouterr()
    name = "corrs.txt" if damage == "points" else "02"
    assert str(pair / name) in said.err and "rootsift" not in said.out


def test_reference_means_of_seeds_hold_their_bounds():
    for scores in itertools.product([0.0, 0.5, 1.0], repeat=2):
        row = {"category": "A", "method": "m", "scores": list(scores), "half": "half A"}
        figure = means([row])["m"]["all"]
        assert figure["min"] <= figure["mean"] <= figure["max"]


def test_without_options_the_presets_are_run_beside_rootsift(root):
    assert WxbsOptions(root=root).chosen_methods(METHODS) == ["rootsift", *PRESETS]


def test_methods_are_different_and_those_of_short_numbers_differ_from_their_preset_in_these_alone():
    assert CONFIGS["paper-naive"] == CONFIGS["paper"]  # they differ in how keypoints are found
    assert len(set(CONFIGS.values())) == len(CONFIGS) - 1
    for kind in ("float16", "bfloat16"):
        short = dataclasses.replace(preset("default"), products=kind)
        assert method_config(f"default-products-{kind}") == short
    with pytest.raises(ValueError, match="default-no-octaves"):
        method_config("default-no-octaves")
