"""Laws of extending a finished run: what is there stays, what is new finds its place."""

import json
import re
import shutil
import sqlite3
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
import pytest
from kept_runs import change_report, with_two_models
from test_localize import POSE, POSITION, SIZE, RecordingEngine, contents, write

from jaxsfm.bench.synthetic import render, room
from jaxsfm.cli.main import main
from jaxsfm.colmap.database import read_matches
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import model_poses, read_poses
from jaxsfm.io.entries import RESULTS
from jaxsfm.io.work_folder import lock_folder
from jaxsfm.options import EngineChoice
from jaxsfm.report.finished_run import read_run
from jaxsfm.report.run_report import read_report
from jaxsfm.runs import extend as extend_module
from jaxsfm.sfm.evaluation import umeyama

OLD = ("view0.png", "view1_night.png", "view2.png")


class Extended(NamedTuple):
    run: Path
    photos: Path
    before: pycolmap.Reconstruction
    after: pycolmap.Reconstruction
    report: dict


@pytest.fixture(scope="module")
def extended(plain, scene, tmp_path_factory) -> Extended:
    """The run of three views with a new one, a photo of elsewhere and a broken one; a first attempt
    is interrupted."""
    folder = tmp_path_factory.mktemp("extend")
    run, photos = folder / "run", folder / "photos"
    shutil.copytree(plain[0], run)
    shutil.copytree(scene / "images", photos)
    write(photos / "new.png", render(room(), POSE, SIZE))
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    write(photos / "elsewhere.png", np.kron(noise, np.ones((4, 4, 1), np.uint8)))
    (photos / "broken.png").write_bytes(b"not an image")
    change_report(run, lambda report: report["images"].update(folder=str(photos)))
    before = {name: each for name, each in contents(run).items() if "sparse" in name}
    report = (run / "report.json").read_text()

    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(extend_module, "grow", interrupted)
        assert main(["extend", str(run)]) == 130
    assert (run / "report.json").read_text() == report
    assert {n: c for n, c in contents(run).items() if "/sparse/" in n and "stages" not in n} == {
        n: c for n, c in before.items() if "stages" not in n
    }
    assert main(["extend", str(run), "--keep-features"]) == 0
    assert len(list(run.glob("features/*/*.safetensors"))) == 5
    return Extended(
        run,
        photos,
        read_model(plain[0] / "sparse" / "0"),
        read_model(run / "sparse" / "0"),
        json.loads((run / "report.json").read_text()),
    )


def test_poses_and_points_that_were_there_stay(extended):
    before, after = model_poses(extended.before), model_poses(extended.after)
    assert set(after) == {*OLD, "new.png"}
    for name in OLD:
        np.testing.assert_allclose(after[name].rotation, before[name].rotation, atol=1e-12)
        np.testing.assert_allclose(after[name].centre, before[name].centre, atol=1e-12)
    points = [
        {tuple(point.xyz) for point in model.points3D.values()}
        for model in (extended.before, extended.after)
    ]
    assert points[0] <= points[1]
    for image_id in extended.before.reg_image_ids():
        assert extended.after.image(image_id).name == extended.before.image(image_id).name


def test_a_new_photo_stands_where_it_was_taken(extended, scene):
    """The three old ones and the truth fix the similarity."""
    poses, truth = model_poses(extended.after), read_poses(scene / "reference")
    ours, theirs = (np.asarray([each[name].centre for name in OLD]) for each in (poses, truth))
    by = umeyama(ours, theirs)
    centre = by.scale * by.rotation @ poses["new.png"].centre + by.translation
    assert np.linalg.norm(centre - POSE.centre) < POSITION
    new = next(i for i in extended.after.images.values() if i.name == "new.png")
    assert new.num_points3D > 100 and new.camera_id == 1


def test_the_report_says_what_was_added_and_what_was_lost(extended, plain):
    report = extended.report
    (row,) = report["extended"]
    assert len(plain[1]["checks"]) == 1 and report["checks"] == []  # other models now
    assert row["added"] == ["elsewhere.png", "new.png"] and row["registered"] == ["new.png"]
    assert report["models"][0]["registered"] == 4
    (lost,) = report["lost"]
    assert lost["image"] == "elsewhere.png" and lost["detail"]
    assert "broken.png" in report["images"]["skipped"] and report["images"]["usable"] == 5
    assert len(report["pairs"]["each"]) == report["pairs"]["tried"] == 3 + 3 + 3 + 1
    assert (extended.run / "report.html").exists()


def test_the_database_has_the_new_images_and_their_matches(extended, plain):
    kept = read_run(extended.run)
    for row in extended.report["pairs"]["each"]:
        pair = tuple(row["pair"])
        result = kept.matches.load_matches(pair)
        assert result is not None and result.num_inliers == row["inliers"]
        xy = read_matches(extended.run / "database.db", pair, verified=False)
        ours = {
            tuple(np.r_[a, b]) for a, b in zip(result.keypoints0, result.keypoints1, strict=True)
        }
        theirs = {tuple(np.float32(np.r_[a, b])) for a, b in zip(*xy, strict=True)}
        assert theirs <= ours and len(theirs) >= 0.95 * len(ours)
        verified = read_matches(extended.run / "database.db", pair, verified=True)[0]
        assert len(verified) == row["colmap_inliers"]
    assert sum("new.png" in row["pair"] for row in extended.report["pairs"]["each"]) == 4


def test_without_new_photos_nothing_changes(extended, capsys):
    before = contents(extended.run)
    assert main(["extend", str(extended.run)]) == 0
    assert "no new photos" in capsys.readouterr().out
    assert contents(extended.run) == before


@pytest.mark.slow
def test_reconstruct_goes_on_from_what_extend_matched(extended, scene, tmp_path, capsys):
    run = Path(shutil.copytree(extended.run, tmp_path / "run"))
    args = ["--out", str(run), "--intrinsics", str(scene / "K.txt"), "--refine", "0"]
    assert main(["reconstruct", str(extended.photos), *args]) == 0
    assert "10 of 10 pairs are matched already" in capsys.readouterr().err


@pytest.fixture
def copied(plain, scene, tmp_path) -> tuple[Path, Path]:
    """A run and its photos, to add to."""
    run = Path(shutil.copytree(plain[0], tmp_path / "run"))
    photos = Path(shutil.copytree(scene / "images", tmp_path / "photos"))
    reference = shutil.copytree(scene / "reference", tmp_path / "reference")
    change_report(run, lambda report: report["images"].update(folder=str(photos)))
    change_report(run, lambda report: report["options"].update(reference=str(reference)))
    return run, photos


@pytest.mark.slow
def test_skipped_photos_are_named_once_and_new_when_they_are_mended(copied, tmp_path, capsys):
    run, photos = copied
    bad = {"broken.png": b"not an image", "cut.png": b""}
    whole = write(photos / "cut.png", render(room(), POSE, SIZE)).read_bytes()
    bad["cut.png"] = whole[:2000]  # its size can be read
    for name, content in bad.items():
        (photos / name).write_bytes(content)
    assert main(["extend", str(run)]) == 1
    text = capsys.readouterr().out
    assert all(f"skipped    {name}" in text for name in bad) and "0 of 0 new photos" in text
    report = read_report(run).to_json()
    assert set(report["images"]["skipped"]) == set(bad) and "evaluation" in report
    assert report["images"]["found"] == 5 and report["images"]["usable"] == 3
    assert main(["extend", str(run)]) == 0 and "no new photos" in capsys.readouterr().out
    for name in bad:
        (photos / name).write_bytes(whole)
    shutil.rmtree(tmp_path / "reference")
    focal = f"PINHOLE:{SIZE[0] + 0.5},{SIZE[0] + 0.5},{SIZE[0] / 2},{SIZE[1] / 2}"
    assert main(["extend", str(run), "--intrinsics", focal]) == 0
    report, model = read_report(run).to_json(), read_model(run / "sparse" / "0")
    assert report["images"]["skipped"] == {} and report["extended"][-1]["added"] == sorted(bad)
    assert report["images"]["found"] == report["images"]["usable"] == 5
    for image in model.images.values():
        if image.name in bad:
            assert model.camera(image.camera_id).params[0] == SIZE[0] + 0.5
    assert model.num_reg_images() == 5 and report["seconds"]["extension"] > 0
    assert "evaluation" not in report and "reference" in report["evaluation_failed"]


@pytest.mark.slow
def test_extend_asks_the_engine_that_was_chosen(copied, monkeypatch):
    run, photos = copied
    write(photos / "new.png", render(room(), POSE, SIZE))
    choices, engine = [], RecordingEngine()
    monkeypatch.setattr(extend_module, "chosen_engine", lambda c: choices.append(c) or engine)
    assert main(["extend", str(run), "--engine", "ray", "--workers", "3"]) == 0
    assert choices == [EngineChoice(engine="ray", workers=3)]
    assert engine.calls == [("extract", 4), ("match", 3)]


@pytest.mark.slow
def test_a_photo_comes_into_the_model_that_it_fits_best_and_others_stay(copied, capsys):
    run, photos = copied
    sparse = with_two_models(run) / "sparse"
    before = {name: each for name, each in contents(run).items() if "/sparse/0/" in name}
    write(photos / "new.png", render(room(), POSE, SIZE))
    assert main(["extend", str(run)]) == 0
    text = capsys.readouterr().out
    assert "registered 1 of 1 new photos in 1 rounds" in text
    assert "sparse/1   1 new photos: 4 images" in text
    assert "sparse/0" not in text and "lost" not in text
    assert [len(each["images"]) for each in read_report(run).to_json()["models"]] == [2, 4]
    assert "new.png" in model_poses(read_model(sparse / "1"))
    assert read_model(sparse / "0").num_reg_images() == 2
    after = contents(run)
    assert before and all(after[name] == each for name, each in before.items())


@pytest.mark.slow
def test_killed_while_publishing_or_beside_another_run_the_report_is_the_newest(
    copied, capsys, monkeypatch
):
    run, _ = copied
    (run / "publishing").mkdir()
    (run / "report.json").rename(run / "publishing" / "report.json")
    moves = {"failed": False, "names": RESULTS}  # the report comes last
    (run / "publishing" / "moves.json").write_text(json.dumps(moves))
    assert main(["extend", str(run)]) == 0
    assert "no new photos" in capsys.readouterr().out and (run / "report.json").exists()
    with lock_folder(run), monkeypatch.context() as patch:
        patch.setattr(extend_module, "read_run", None)  # what it says may be old soon
        assert main(["extend", str(run)]) == 2
    assert "another run" in capsys.readouterr().err


def test_what_cannot_be_extended_is_one_sentence(plain, tmp_path, capsys):
    def says(*args) -> str:
        assert main(["extend", *map(str, args)]) == 2
        text = capsys.readouterr().err
        assert text.startswith("jaxsfm: ") and text.count("\n") == 1, text
        return text

    assert "no finished run" in says(tmp_path)
    run = Path(shutil.copytree(plain[0], tmp_path / "run"))
    assert "no such folder" in says(run, "--images", tmp_path / "none")
    change_report(run, lambda report: report["identity"].update(version="0.0.1"))
    assert "was made by jaxsfm 0.0.1" in says(run)
    change_report(run, lambda report: report.update(models=[]))
    assert "no model to extend" in says(run)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("UPDATE images SET name = 'z' WHERE name = 'view0.png'", "is not of .*: view0.png is"),
        ("UPDATE keypoints SET data = x'00'", r"keypoints, row 1 \(.*\): .* values expected"),
        ("CREATE TRIGGER t AFTER INSERT ON images BEGIN SELECT 1; END", "has triggers"),
    ],
)
def test_a_database_that_is_not_the_runs_is_refused_before_the_work(
    plain, scene, tmp_path, monkeypatch, capsys, change, why
):
    run, photos = tmp_path / "run", tmp_path / "photos"
    shutil.copytree(plain[0], run)
    shutil.copytree(scene / "images", photos)
    write(photos / "new.png", render(room(), POSE, SIZE))
    with sqlite3.connect(run / "database.db") as db:
        db.execute(change)
    monkeypatch.setattr(extend_module, "_match_new", None)
    assert main(["extend", str(run), "--images", str(photos)]) == 2
    assert re.search(rf"^jaxsfm: .*database\.db: {why}", capsys.readouterr().err)
