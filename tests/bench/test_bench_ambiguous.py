"""`bench ambiguous`: its options, its table, and one small scene from end to end."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from jaxsfm.bench.ambiguous import cells, counts, table_lines
from jaxsfm.bench.judges import OUTCOMES
from jaxsfm.bench.methods import AMBIGUOUS_METHODS, METHODS, method_config
from jaxsfm.bench.model_options import AmbiguousOptions
from jaxsfm.bench.strecha_models import take_matches
from jaxsfm.cli.main import main
from jaxsfm.config import preset
from jaxsfm.errors import UserError


def test_colmaps_mappers_get_the_matches_of_default_and_all_of_its_pairs():
    config = method_config("colmap", max_size=400)
    assert config == method_config("colmap-global", max_size=400)
    assert config.matching() == dataclasses.replace(preset("default"), max_size=400).matching()
    assert not config.view_graph and config.refinement is None
    more = {*AMBIGUOUS_METHODS} - {*METHODS}
    assert more == {"rootsift+refined", "aliked+lightglue", "colmap", "colmap-global"}


def test_matches_are_taken_from_another_method_only_into_a_new_folder(tmp_path):
    first, second = tmp_path / "default", tmp_path / "colmap"
    take_matches(second, first)
    assert not second.exists()  # there is nothing to take
    (first / "matches" / "ab").mkdir(parents=True)
    (first / "matches" / "ab" / "cd.safetensors").write_bytes(b"matches")
    (first / "run.json").write_text("{}")
    take_matches(second, first)
    assert (second / "matches" / "ab" / "cd.safetensors").read_bytes() == b"matches"
    (first / "matches" / "ab" / "cd.safetensors").write_bytes(b"others")
    take_matches(second, first)
    assert (second / "matches" / "ab" / "cd.safetensors").read_bytes() == b"matches"


def row(method, outcome, *, position=None, models=(8, 3)):
    return {
        "set": "synthetic-box",
        "size": 400,
        "seed": 1,
        "method": method,
        "images": 12,
        "models": [*models],
        "groups": [[6, 2], [3]],
        "alternative": [],
        "outcome": outcome,
        "position": position and {"mean": position},
        "rotation_deg": position and {"mean": 1.5},
        "position_share": position and position / 10,
        "not_evaluated": "" if position else "no model",
        "stages": {"all": 2.0},
    }


def test_the_table_ends_with_the_number_of_each_outcome_of_each_method():
    rows = [
        row("colmap", "wrong, not noticed", position=0.5),
        row("colmap", "right", position=0.001),
        row("default", "no model", models=()),
    ]
    got = counts(rows)
    assert got["colmap"] == dict.fromkeys(OUTCOMES, 0) | {"right": 1, "wrong, not noticed": 1}
    assert got["default"]["no model"] == 1
    lines = table_lines({"rows": rows, "summary": got})
    many = row("colmap", "right") | {"groups": [[4, 3, 2, 2, 1]]}
    assert cells(many)["groups"] == "4+3+2+2+..." and "other model" not in cells(many)
    assert cells(many | {"alternative": [12]})["other model"] == "12"
    words = "synthetic-box colmap 400 1 8/12 2 6+2 0.5000 1.500 5.00% 2.0 wrong, not noticed"
    assert lines[1].split() == words.split()
    assert "synthetic-box default: no model" in lines
    assert lines[-3].split()[:3] == ["method", "right", "split"]
    assert lines[-2].split() == ["colmap", "1", "0", "0", "1", "0"]


def test_sizes_are_numbers_separated_by_commas_or_blanks():
    assert AmbiguousOptions(sizes=("400,600", "800")).chosen_sizes() == [400, 600, 800]
    assert AmbiguousOptions(sizes=("400,400",)).chosen_sizes() == [400]
    wrong = (("400,x", "'x'"), ("", "none given"), ("8", "at least"), ("60", "three quarters"))
    for sizes, word in wrong:
        with pytest.raises(UserError, match=word):
            AmbiguousOptions(sizes=(sizes,))


def test_a_set_may_not_be_called_as_a_synthetic_scene(strecha, tmp_path, capsys):
    shutil.copytree(strecha / "room", tmp_path / "synthetic-box")
    assert main(["bench", "ambiguous", "--root", str(tmp_path), "--sets", "synthetic-box"]) == 2
    assert "synthetic-box is the name of a synthetic scene" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["--root", "/nowhere"], "no such folder"),
        (["--sets", "synthetic-castle"], "no set 'synthetic-castle'"),
        (["--sets", ""], "--sets: none given"),
        (["--sizes", "-800"], "--sizes"),
        (["--seeds", "0"], "--seeds"),
        (["--threads", "0"], "--threads"),
        (["--methods", "glomap"], "no method 'glomap'"),
        (["--json", "figures.txt"], "--json"),
        (["--out", "{file}", "--sets", "synthetic-box", "--sizes", "64"], "cannot be written"),
    ],
)
def test_what_cannot_be_benchmarked_is_said(tmp_path, capsys, args, word):
    (tmp_path / "file").write_text("")
    args = [arg.format(file=tmp_path / "file") for arg in args]
    assert main(["bench", "ambiguous", *args]) == 2
    error = capsys.readouterr().err
    assert word in error and "Traceback" not in error


@pytest.mark.slow
def test_a_scene_and_a_set_run_from_end_to_end_and_go_on_where_they_were(strecha, tmp_path, capsys):
    root, out = tmp_path / "sets", tmp_path / "figures.json"
    shutil.copytree(strecha, root)
    args = ["bench", "ambiguous", "--root", str(root), "--json", str(out), "--threads", "1"]
    args += ["--sizes", "240", "--out", str(tmp_path / "work")]
    assert main([*args, "--sets", "room", "--methods", "rootsift,default"]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [row["method"] for row in rows] == ["rootsift", "default"]
    assert rows[1]["outcome"] == "right"  # the room of the demo does not repeat itself

    methods = ["default", "colmap", "colmap-global"]
    assert main([*args, "--sets", "synthetic-street", "--methods", ",".join(methods)]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [row["method"] for row in rows] == methods
    for row in rows:
        assert row["images"] == 15 and row["outcome"] in OUTCOMES and row["size"] == 240
        # A group is a part of a model, and COLMAP has nothing to say against its models.
        assert all(
            sum(own) <= count for own, count in zip(row["groups"], row["models"], strict=False)
        )
        assert row["method"] == "default" or not row["doubt"]
    text = capsys.readouterr().out
    assert "wrong, not noticed" in text

    work = tmp_path / "work" / "synthetic-street" / "240" / "seed0"
    assert len(list((work / "scene" / "images").glob("*.png"))) == 15
    own, taken = (_files(work / method / "matches") for method in ("default", "colmap"))
    assert own == taken and own
    before = {path: path.stat().st_mtime_ns for path in work.rglob("matches/*/*.safetensors")}
    assert main([*args, "--sets", "synthetic-street", "--methods", "default"]) == 0
    again = json.loads(out.read_text())["rows"]
    assert [each["groups"] for each in again] == [rows[0]["groups"]]
    assert before == {
        path: path.stat().st_mtime_ns for path in work.rglob("matches/*/*.safetensors")
    }


def _files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*.safetensors")}
