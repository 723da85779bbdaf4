"""A run that describes its photos at a small size first."""

import json
import shutil
import sqlite3
from pathlib import Path

import pycolmap
import pytest

from jaxsfm.cli.main import main
from jaxsfm.io.looks import SECOND_CELLS
from jaxsfm.io.store import Store
from jaxsfm.report.finished_run import read_run
from jaxsfm.report.page.close_ups import close_ups
from jaxsfm.report.page.pair_pictures import pair_pictures
from jaxsfm.runs import run_stages
from jaxsfm.sfm.second_look import SecondLook

FIRST_PX = 200
"""The longer side of the photos in the first look; they have 320 pixels."""
MODEL = ("cameras.bin", "images.bin", "points3D.bin")

pytestmark = pytest.mark.slow


def run(scene: Path, out: Path, *args: str) -> dict:
    known = ["--intrinsics", str(scene / "K.txt"), "--threads", "1"]
    look = ["--first-look", str(FIRST_PX)]
    images = str(scene / "images")
    assert main(["reconstruct", images, "--out", str(out), *known, *look, *args]) == 0
    return json.loads((out / "report.json").read_text())


@pytest.fixture(scope="module")
def looked(scene, tmp_path_factory) -> tuple[Path, dict]:
    """A run whose first look settles all photos, and its report."""
    out = tmp_path_factory.mktemp("looked") / "out"
    return out, run(scene, out)


def test_where_the_first_look_settles_all_photos_nothing_is_described_at_full_size(looked):
    out, report = looked
    assert report["models"][0]["registered"] == 3
    assert report["looks"] == {
        "first_px": FIRST_PX,
        "photos": [],
        "again": [],
        "whole": False,
        "in_vain": False,
    }
    # One pass more than the preset has, at full size.
    assert len(report["refinement"][0]["passes"]) == 3
    assert len(list((out / "matches").rglob("*.safetensors"))) == 3


def test_the_refinement_works_at_full_size(looked):
    """At 200 pixels, a pixel of the photo is 0.6 working pixels: the error would be 1.6 times."""
    out, _ = looked
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert model.compute_mean_reprojection_error() < 0.2


def test_pages_show_the_matches_and_the_cells_of_the_first_look(looked):
    found = read_run(looked[0])
    pictures, _ = pair_pictures(found)
    assert pictures
    shown = [patch for track in close_ups(found) for patch in track.patches if patch.cell]
    assert shown
    for patch in shown:  # the keypoint that was walked to lies in its cell
        assert patch.cell is not None and patch.walked is not None
        for place, corner in zip(patch.walked, patch.cell, strict=True):
            assert corner - 0.01 <= place <= corner + 8.01


def test_the_same_run_again_computes_nothing(looked, scene, tmp_path, monkeypatch):
    out = Path(shutil.copytree(looked[0], tmp_path / "out"))
    for name in ("save_features", "save_matches"):
        monkeypatch.delattr(Store, name)
    assert run(scene, out)["models"] == looked[1]["models"]


def test_a_second_look_at_everything_gives_what_one_look_gives(
    looked, plain, scene, tmp_path, monkeypatch
):
    """The first look leaves nothing behind."""
    out = Path(shutil.copytree(looked[0], tmp_path / "out"))

    def everything(counts, photos, settled, trusted, **_):
        return SecondLook(sorted(photos), sorted(counts), whole=True)

    monkeypatch.setattr(run_stages, "second_look", everything)
    report = run(scene, out)
    assert report["looks"]["whole"] and len(report["looks"]["again"]) == 3
    for name in MODEL:
        one, two = (folder / "sparse" / "0" / name for folder in (plain[0], out))
        assert one.read_bytes() == two.read_bytes()
    assert report["pairs"] == plain[1]["pairs"]


def test_a_second_look_at_one_pair_adds_its_matches_to_those_of_the_first_one(
    looked, plain, scene, tmp_path, monkeypatch
):
    out = Path(shutil.copytree(looked[0], tmp_path / "out"))
    first, second, third = sorted(plain[1]["identity"]["images"])

    def one_pair(counts, photos, settled, trusted, **_):
        return SecondLook([third], [(second, third)], whole=False)

    monkeypatch.setattr(run_stages, "second_look", one_pair)
    report = run(scene, out)
    assert report["looks"]["photos"] == [third] and not report["looks"]["whole"]
    once, full, both = (
        {tuple(row["pair"]): row["inliers"] for row in each["pairs"]["each"]}
        for each in (looked[1], plain[1], report)
    )
    again = (second, third)
    assert both == once | {again: once[again] + full[again]}
    with sqlite3.connect(out / "database.db") as db:
        written = db.execute("select sum(rows) from matches").fetchone()[0]
    db.close()
    assert written == sum(both.values())
    found = read_run(out)
    united, once = map(found.matches.load_matches, (again, (first, second)))
    assert united is not None and ((united.cells >= SECOND_CELLS).sum(0) == full[again]).all()
    assert once is not None and (once.cells < SECOND_CELLS).all()
    assert report["models"][0]["registered"] == 3
    assert pair_pictures(found)[0] and close_ups(found)


def test_the_model_of_the_first_look_stays_if_the_second_one_gives_no_better_one(
    looked, scene, tmp_path, monkeypatch
):
    """At full size, a photo is lost."""
    out = Path(shutil.copytree(looked[0], tmp_path / "out"))
    third = sorted(looked[1]["identity"]["images"])[2]

    def everything(counts, photos, settled, trusted, **_):
        return SecondLook([third], sorted(counts), whole=True)

    monkeypatch.setattr(run_stages, "second_look", everything)
    photos = run_stages.MappedRun.photos.func

    def without_one(mapped):
        lost = {third} if mapped.cache.suffix else set()
        return [names - lost for names in photos(mapped)]

    monkeypatch.setattr(run_stages.MappedRun, "photos", property(without_one))
    report = run(scene, out)
    assert report["looks"]["in_vain"] and report["looks"]["whole"]
    for key in ("models", "pairs", "refinement"):
        assert report[key] == looked[1][key]
    found = read_run(out)
    assert pair_pictures(found)[0] and close_ups(found)
