"""`jaxsfm export --to undistorted` finds the photos of a run, and writes a whole folder or none."""

import json

import cv2
import numpy as np
import pycolmap
import pytest
from foreign_model import NAMES, camera, exact_model

from jaxsfm.cli.main import main


@pytest.fixture
def run(tmp_path):
    """A run of four photos through a lens with distortion; its report says where they are."""
    model, folder, photos = exact_model([camera("OPENCV")]), tmp_path / "run", tmp_path / "photos"
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")
    for name in NAMES:
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(photos / name), np.full((768, 1024, 3), 90, np.uint8))
    (folder / "report.json").write_text(json.dumps({"images": {"folder": str(photos)}}))
    return folder


def export(run, out, *more):
    return main(["export", str(run), "--to", "undistorted", "--out", str(out), *map(str, more)])


def refusal(capsys, *args) -> str:
    assert export(*args) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("jaxsfm: ")
    return line


def test_the_photos_of_the_run_are_undistorted_at_the_size_that_was_asked_for(run, tmp_path):
    (tmp_path / "b").mkdir()
    for out, more in (("a", ()), ("b", ("--max-size", 300))):
        assert export(run, tmp_path / out, *more) == 0
        made = pycolmap.Reconstruction(tmp_path / out / "sparse").camera(1)
        for name in NAMES:
            size = cv2.imread(str(tmp_path / out / "images" / name)).shape[1::-1]
            assert size == (made.width, made.height)
            assert max(size) == 300 if more else max(size) > 1000
    assert not list(tmp_path.glob(".jaxsfm-*"))


def test_a_models_own_folder_needs_the_photos_named(run, tmp_path, capsys):
    model, photos = run / "sparse" / "0", tmp_path / "photos"
    message = refusal(capsys, model, tmp_path / "a")
    assert "--to undistorted" in message and "name them with --images" in message
    assert export(model, tmp_path / "a", "--images", photos) == 0
    capsys.readouterr()
    (photos / NAMES[1]).write_bytes(b"no photo")
    assert NAMES[1] in refusal(capsys, run, tmp_path / "b")
    assert not (tmp_path / "b").exists() and not list(tmp_path.glob(".jaxsfm-*"))


def test_options_of_other_formats_are_refused(run, tmp_path, capsys):
    assert "goes with --to nerfstudio" in refusal(capsys, run, tmp_path / "a", "--copy-images")
    assert "at least 48" in refusal(capsys, run, tmp_path / "a", "--max-size", 47)
    args = ["export", str(run), "--to", "colmap", "--out", str(tmp_path / "a"), "--max-size", "99"]
    assert main(args) == 2
    assert "goes with --to undistorted" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_what_is_there_is_not_overwritten(run, tmp_path, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    assert "choose an empty or new folder" in refusal(capsys, run, tmp_path / "full")
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]
