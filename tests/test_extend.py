"""Laws of extending a finished run: what is there stays, what is new finds its place."""

import json
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
import pytest
from kept_runs import change_report
from test_localize import POSE, POSITION, SIZE, contents, write

from jaxsfm import extend as extend_module
from jaxsfm.cli import main
from jaxsfm.evaluation import umeyama
from jaxsfm.host.colmap import read_matches
from jaxsfm.host.poses import model_poses, read_model, read_poses
from jaxsfm.kept import read_run
from jaxsfm.synthetic import render, room

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
    assert main(["extend", str(run)]) == 0
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


def test_the_report_says_what_was_added_and_what_was_lost(extended):
    report = extended.report
    (row,) = report["extended"]
    assert row["added"] == ["elsewhere.png", "new.png"] and row["placed"] == ["new.png"]
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
        result = kept.load_matches(pair)
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


def test_reconstruct_goes_on_from_what_extend_matched(extended, scene, tmp_path, capsys):
    run = Path(shutil.copytree(extended.run, tmp_path / "run"))
    args = ["--out", str(run), "--intrinsics", str(scene / "K.txt"), "--refine", "0"]
    assert main(["reconstruct", str(extended.photos), *args]) == 0
    assert "10 of 10 pairs have been matched before" in capsys.readouterr().err


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
