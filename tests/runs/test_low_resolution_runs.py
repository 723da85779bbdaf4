"""A run that describes its photos at a small size."""

import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from jaxsfm.cli.main import main
from jaxsfm.config import preset
from jaxsfm.io.store import Store
from jaxsfm.report.finished_run import read_run
from jaxsfm.report.page.pairs import pair_pictures
from jaxsfm.runs import run_stages
from jaxsfm.sfm.mapped_stage import MatchedPhotos
from jaxsfm.sfm.refined_stage import Reconstructed

FIRST_PX = 200
"""The longer side of the photos when they are described; they have 320 pixels."""
MODEL = ("cameras.bin", "images.bin", "points3D.bin")

pytestmark = pytest.mark.slow


def run(scene: Path, out: Path, *args: str) -> dict:
    known = ["--intrinsics", str(scene / "K.txt"), "--threads", "1"]
    look = ["--low-resolution", str(FIRST_PX)]
    images = str(scene / "images")
    assert main(["reconstruct", images, "--out", str(out), *known, *look, *args]) == 0
    return json.loads((out / "report.json").read_text())


@pytest.fixture(scope="module")
def looked(scene, tmp_path_factory) -> tuple[Path, dict]:
    """A run in which all photos find a place, and its report."""
    out = tmp_path_factory.mktemp("looked") / "out"
    return out, run(scene, out)


def test_where_all_photos_find_a_place_none_is_described_at_full_size(looked):
    out, report = looked
    assert report["models"][0]["registered"] == 3
    assert report["low_resolution"] == {"px": FIRST_PX, "whole": False}
    # One pass more than the preset has, at full size.
    assert len(report["refinement"][0]["passes"]) == 3
    assert len(list((out / "matches").rglob("*.safetensors"))) == 3


def test_the_refinement_works_at_full_size(looked):
    """At 200 pixels, a pixel of the photo is 0.6 working pixels: the error would be 1.6 times."""
    out, _ = looked
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert model.compute_mean_reprojection_error() < 0.2


def test_pages_show_the_matches_of_photos_at_a_small_size(looked):
    found = read_run(looked[0])
    pictures, _ = pair_pictures(found)
    assert pictures
    for picture in pictures:
        lines = "".join(plane.lines for plane in picture.planes)
        ends = np.asarray(re.findall(r"(\d+) (\d+)L(\d+) (\d+)", lines), int)
        first, second = picture.photos
        assert len(ends) and (ends[:, 0] <= first.width).all()
        assert (picture.shift <= ends[:, 2]).all()
        assert (ends[:, 2] <= picture.shift + second.width).all()
        assert (ends[:, 1::2] <= [first.height, second.height]).all()


def test_the_same_run_again_computes_nothing(looked, scene, tmp_path, monkeypatch):
    out = Path(shutil.copytree(looked[0], tmp_path / "out"))
    for name in ("save_features", "save_matches"):
        monkeypatch.delattr(Store, name)
    assert run(scene, out)["models"] == looked[1]["models"]


def test_photos_that_give_no_model_at_a_small_size_are_matched_at_full_size(
    looked, plain, scene, tmp_path, monkeypatch
):
    """The model is that of a run which describes its photos at full size from the beginning."""
    out = Path(shutil.copytree(looked[0], tmp_path / "out"))
    sizes, walk = [], run_stages.walk

    def no_model_at_first(given: MatchedPhotos, *args: Any, **options: Any) -> Reconstructed:
        sizes.append(given.described.max_size)
        made = walk(given, *args, **options)
        if sizes[1:]:
            return made
        mapping = dataclasses.replace(made.mapping, checks=[])
        return dataclasses.replace(made, mapping=mapping, models=[], refinement=[])

    monkeypatch.setattr(run_stages, "walk", no_model_at_first)
    report = run(scene, out)
    assert sizes == [FIRST_PX, preset("default").max_size]
    assert report["low_resolution"] == {"px": FIRST_PX, "whole": True}
    assert report["pairs"] == plain[1]["pairs"] and report["models"] == plain[1]["models"]
    for name in MODEL:
        one, two = (folder / "sparse" / "0" / name for folder in (plain[0], out))
        assert one.read_bytes() == two.read_bytes()
    assert pair_pictures(read_run(out))[0]
