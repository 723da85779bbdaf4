"""`bench strecha` on a rendered set in Strecha's layout."""

import json
import re
import shutil

import pytest

from jaxsfm.bench.inputs import find_sets
from jaxsfm.bench.methods import method_config
from jaxsfm.bench.strecha import PUBLISHED, means, ratios, table_lines
from jaxsfm.cli.main import main
from jaxsfm.config import preset


@pytest.fixture(scope="module")
def root(strecha):
    return strecha


@pytest.mark.slow
def test_all_methods_run_side_by_side_and_give_one_table(root, tmp_path, capsys):
    out = tmp_path / "figures.json"
    args = ["bench", "strecha", "--root", str(root), "--json", str(out)]
    assert main([*args, "--out", str(tmp_path / "work"), "--threads", "1"]) == 0
    text, figures = capsys.readouterr().out, json.loads(out.read_text())
    rows = {row["method"]: row for row in figures["rows"]}
    assert tuple(rows) == ("rootsift", "rootsift+refined", "grid", "reloc", "default")
    for method, row in rows.items():
        assert (
            row["set"] == "room"
            and row["images"] == 3
            and re.search(rf"^room +{re.escape(method)} ", text, re.M)
        )
        assert sum(row["stages"].values()) > 0
        assert (tmp_path / "work" / "room" / method / "sparse").is_dir()
    models = {method: row["model"] for method, row in rows.items()}
    for method in ("grid", "reloc", "default"):  # the third view is RootSIFT's to lose: it is night
        assert rows[method]["registered"] == 3 and models[method]["focal_error_percent"] == 0
    default, reloc = models["default"], models["reloc"]
    assert default["reprojection_error_px"] < 0.5 * reloc["reprojection_error_px"]
    for row in rows.values():
        assert 0 < row["own_rotation_deg"] < 1.1 * row["rotation_deg"]["mean"]
    refined, bare = models["rootsift+refined"], models["rootsift"]
    assert refined["reprojection_error_px"] < 0.5 * bare["reprojection_error_px"]
    assert rows["rootsift+refined"]["stages"].keys() == {"matching", "mapping", "refinement"}
    assert all(1e8 < row["peak_bytes"] < 1e10 for row in rows.values())
    assert "published" in text
    for column in (
        "own rotation",
        "extraction",
        "matching",
        "mapping",
        "refinement",
        "seconds",
        "GB",
    ):
        assert re.search(rf"^set .* {column}\b", text, re.M)

    again = ["--methods", "reloc,default", "--sets", "room", "--intrinsics", "unknown"]
    assert main([*args, *again, "--out", str(tmp_path / "work")]) == 0
    again = json.loads(out.read_text())["rows"]
    assert [row["method"] for row in again] == ["reloc", "default"]
    for row in again:
        assert row["model"]["focal_error_percent"] > 0
        for stage in ("extraction", "matching"):  # done once, counted in both runs
            assert row["stages"][stage] == rows[row["method"]]["stages"][stage]


def test_methods_differ_in_the_switch_they_name():
    default = preset("default")
    assert method_config("default") == default
    for method, keypoints in (
        ("grid", "grid"),
        ("reloc", "relocalized"),
        ("learned", "learned"),
    ):
        config = method_config(method)
        assert config.keypoints == keypoints and config.refinement is None
        assert config.view_graph and config.pair == default.pair


def row(name, method, position, points):
    return {
        "set": name,
        "method": method,
        "position": {"mean": position},
        "rotation_deg": {"mean": 2 * position},
        "model": {"points": points, "reprojection_error_px": 0.5 * position},
        "stages": {"matching": 2.0 * points, "mapping": points},
    }


def test_ratios_are_means_of_the_sets_ratios():
    rows = [
        row("a", "rootsift", 1.0, 10),
        row("a", "default", 0.5, 20),
        row("b", "rootsift", 2.0, 10),
        row("b", "default", 3.0, 30),
        row("c", "default", 1.0, 1),  # nothing to compare with
        {"set": "b", "method": "grid", "model": None},
    ]
    got = ratios(rows)
    assert set(got) == {"default"} and set(got["default"]) == {"a", "b", "mean"}
    assert got["default"]["mean"] == {
        "position": 1.0,
        "rotation": 1.0,
        "points": 2.5,
        "reprojection error": 1.0,
        "seconds": 2.5,
    }


def test_the_table_ends_with_the_means_of_the_sets_and_the_published_ones():
    rows = [row("a", "paper", 1.0, 10), row("b", "paper", 3.0, 10), row("b", "paper-grid", 2.0, 1)]
    rows.append({"set": "a", "method": "paper-grid", "position": None, "rotation_deg": None})
    got = means(rows)
    assert got == {
        "paper": {"sets": 2, "position": 2.0, "rotation_deg": 4.0},
        "paper-grid": {"sets": 1, "position": 2.0, "rotation_deg": 4.0},
    }
    lines = table_lines({"rows": [], "summary": {"means": got, "ratios": {}}})
    assert lines[1].split() == ["mean,", "sets:", "2", "paper", "2.0000", "4.0000"]
    for (name, (position, rotation)), line in zip(PUBLISHED.items(), lines[-2:], strict=True):
        assert line.startswith("published") and name in line
        assert [float(value) for value in line.split()[-2:]] == [position, rotation]


@pytest.mark.slow
def test_only_the_best_pairs_are_mapped(root, tmp_path):
    """Three views have three pairs; with one pair for each view, one of them is not mapped."""
    args = ["bench", "strecha", "--root", str(root), "--methods", "paper", "--threads", "1"]
    handed = []
    for name, more in (("all", []), ("best", ["--best-pairs", "1"])):
        assert main([*args, *more, "--out", str(tmp_path / name)]) == 0
        report = json.loads((tmp_path / name / "room/paper/report.json").read_text())
        handed.append(report["pairs"]["handed_on"])
    assert handed == [3, 2]


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["--root", "/nowhere"], "no such folder"),
        (["--root", "{root}", "--best-pairs", "0"], "--best-pairs"),
        (["--root", "{root}", "--methods", "reloc", "--weights", "/nowhere"], "/nowhere: cannot"),
        (["--root", "{root}", "--sets", "cathedral"], "no set 'cathedral'"),
        (["--root", "{root}/room"], "no Strecha sets"),
        (["--root", "{root}", "--methods", "default,orb"], "no method 'orb'"),
        (["--root", "{root}", "--json", "figures.txt"], "--json"),
    ],
)
def test_what_cannot_be_benchmarked_is_said(root, capsys, args, word):
    assert main(["bench", "strecha", *(a.format(root=root) for a in args)]) == 2
    error = capsys.readouterr().err
    assert word in error and "Traceback" not in error


def test_a_camera_matrix_that_is_none_is_named(root, tmp_path, capsys):
    shutil.copytree(root / "room", tmp_path / "odd")
    (tmp_path / "odd" / "images" / "K.txt").write_text("1 2 3")
    assert main(["bench", "strecha", "--root", str(tmp_path)]) == 2
    assert "K.txt" in capsys.readouterr().err
    assert [path.name for path in find_sets(tmp_path, None)] == ["odd"]
