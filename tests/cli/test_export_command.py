"""`jaxsfm export`: every format of a run's folder, read back by its tool; and what is refused."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from foreign_model import NAMES, camera, exact_model, image_files, write_run
from plyfile import PlyData

from jaxsfm.cli.main import main
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.formats.hloc import FEATURES, MATCHES, read_hloc

FOLDERS = ["hloc", "colmap", "colmap-text", "nerfstudio"]
ALL = [*FOLDERS, "ply"]


@pytest.fixture(scope="module")
def model():
    return exact_model([camera("SIMPLE_PINHOLE"), camera("SIMPLE_PINHOLE", 2)])


@pytest.fixture(scope="module")
def run(tmp_path_factory, model):
    return write_run(tmp_path_factory.mktemp("a run") / "out", model)


def target(tmp_path, to):
    return tmp_path / ("model.ply" if to == "ply" else "made")


def export(run, to, out, *more):
    return main(["export", str(run), "--to", to, "--out", str(out), *map(str, more)])


def refusal(capsys, *args) -> str:
    assert export(*args) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("jaxsfm: ")
    return line


@pytest.mark.parametrize("to", ["colmap", "colmap-text"])
def test_colmap_reads_the_same_model_back(tmp_path, run, model, to):
    assert export(run, to, tmp_path / "new" / "made") == 0
    back = pycolmap.Reconstruction(tmp_path / "new" / "made")
    assert back.num_points3D() == model.num_points3D()
    for image_id, image in model.images.items():
        other = back.image(image_id)
        assert other.name == image.name
        assert np.allclose(other.cam_from_world().matrix(), image.cam_from_world().matrix())
        for a, b in zip(image.points2D, other.points2D, strict=True):
            assert np.allclose(a.xy, b.xy, atol=1e-6) and a.point3D_id == b.point3D_id
    for camera_id, own in model.cameras.items():
        assert np.allclose(back.camera(camera_id).params, own.params)


def test_a_ply_holds_the_points_and_their_colours(tmp_path, run, model):
    assert export(run, "ply", tmp_path / "points.ply") == 0
    vertices = PlyData.read(tmp_path / "points.ply")["vertex"]
    found = {int(v["red"]): [float(v[axis]) for axis in "xyz"] for v in vertices}
    assert len(vertices) == len(found) == model.num_points3D()
    for point in model.points3D.values():
        assert np.allclose(found[int(point.color[0])], point.xyz, atol=1e-5)


@pytest.mark.parametrize("chosen", ["all", "verified"])
def test_hloc_gets_the_matches_that_were_asked_for(tmp_path, run, chosen):
    assert export(run, "hloc", tmp_path / "h", "--matches", chosen) == 0
    back = read_hloc(tmp_path / "h" / FEATURES, tmp_path / "h" / MATCHES, NAMES, where="h")
    with pycolmap.Database.open(run / "database.db") as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        for (a, b), rows in back.matches.items():
            if chosen == "all":
                wanted = db.read_matches(ids[a], ids[b])
            else:
                wanted = db.read_two_view_geometry(ids[a], ids[b]).inlier_matches
            assert set(map(tuple, rows)) == set(map(tuple, np.asarray(wanted).tolist()))
    assert len(back.matches) == (6 if chosen == "all" else 1)


def test_the_uncertainty_is_a_working_pixel(tmp_path, run, model):
    import h5py

    report = {"options": {"config": {"max_size": 256, "enlarge": 1.0}}}
    copy = write_run(tmp_path / "run", model)
    (copy / "report.json").write_text(json.dumps(report))
    for folder, expected in ((run, 1.0), (copy, 4.0)):
        assert export(folder, "hloc", tmp_path / folder.name / "h") == 0
        with h5py.File(tmp_path / folder.name / "h" / FEATURES) as file:
            assert file["sub/b.jpg/keypoints"].attrs["uncertainty"] == expected


def test_a_run_without_a_model_gives_its_matches_and_says_so_of_the_rest(tmp_path, model, capsys):
    bare = write_run(tmp_path / "bare", model, with_model=False)
    assert export(bare, "hloc", tmp_path / "h") == 0
    capsys.readouterr()
    for to in ("colmap", "colmap-text", "ply", "nerfstudio"):
        assert "no COLMAP model here" in refusal(capsys, bare, to, target(tmp_path, to))
        assert not target(tmp_path, to).exists()


def test_a_models_own_folder_is_enough_for_a_model(tmp_path, run, capsys):
    for to in ("colmap", "ply", "nerfstudio"):
        assert export(run / "sparse" / "0", to, target(tmp_path / to, to)) == (
            2 if to == "ply" else 0
        )
    capsys.readouterr()
    assert "no database.db here" in refusal(capsys, run / "sparse" / "0", "hloc", tmp_path / "h")


def test_an_empty_model_is_exported_empty(tmp_path):
    folder = tmp_path / "empty" / "sparse" / "0"
    folder.mkdir(parents=True)
    pycolmap.Reconstruction().write_binary(folder)
    write_database(tmp_path / "empty" / "database.db", image_files(NAMES, folder), {}, Cameras())
    for to in ALL:
        (tmp_path / to).mkdir()
        assert export(tmp_path / "empty", to, target(tmp_path / to, to)) == 0
    meta = json.loads((tmp_path / "nerfstudio" / "made" / "transforms.json").read_text())
    assert meta["frames"] == []


@pytest.mark.parametrize("to", ALL)
def test_what_is_there_is_not_overwritten_and_what_cannot_be_written_is_said(
    tmp_path, run, capsys, to
):
    suffix = target(tmp_path, to).name
    if to in FOLDERS:
        (tmp_path / "full").mkdir()
        (tmp_path / "full" / "mine.txt").write_text("mine")
        assert "choose an empty or new folder" in refusal(capsys, run, to, tmp_path / "full")
        assert [p.name for p in (tmp_path / "full").iterdir()] == ["mine.txt"]
        (tmp_path / "file").write_text("mine")
        assert "is a file, not a folder" in refusal(capsys, run, to, tmp_path / "file")
        assert (tmp_path / "file").read_text() == "mine"
        assert "cannot be written" in refusal(capsys, run, to, tmp_path / "file" / "below")
        (tmp_path / "empty").mkdir()
        assert export(run, to, tmp_path / "empty") == 0
        assert any((tmp_path / "empty").iterdir())
    else:
        assert "must end in" in refusal(capsys, run, to, tmp_path / "made")
        (tmp_path / suffix).mkdir()
        assert "cannot be written" in refusal(capsys, run, to, tmp_path / suffix)
    if getattr(os, "geteuid", lambda: 0)():  # root may write anywhere
        (tmp_path / "locked").mkdir(mode=0o500)
        assert "cannot be written" in refusal(capsys, run, to, tmp_path / "locked" / suffix)
    assert not list(tmp_path.glob(".jaxsfm-*"))


def test_a_failed_export_leaves_nothing(tmp_path, capsys):
    mixed = exact_model([camera("PINHOLE"), camera("OPENCV_FISHEYE", 2)])
    run = write_run(tmp_path / "run", mixed)
    assert "OPENCV_FISHEYE" in refusal(capsys, run, "nerfstudio", tmp_path / "made")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run"]


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "my photos"
    for name in NAMES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    return folder


def test_nerfstudios_images_are_referred_to_or_copied(tmp_path, run, photos, capsys):
    def paths(out):
        meta = json.loads((out / "transforms.json").read_text())
        return [out / frame["file_path"] for frame in meta["frames"]]

    assert export(run, "nerfstudio", tmp_path / "r", "--images", photos) == 0
    assert export(run, "nerfstudio", tmp_path / "c", "--images", photos, "--copy-images") == 0
    for out, below in ((tmp_path / "r", photos), (tmp_path / "c", tmp_path / "c" / "images")):
        assert [path.read_text() for path in paths(out)] == sorted(NAMES)
        assert all(path.is_relative_to(below) for path in paths(out))
    (photos / NAMES[2]).unlink()
    capsys.readouterr()
    message = refusal(
        capsys, run, "nerfstudio", tmp_path / "n", "--images", photos, "--copy-images"
    )
    assert NAMES[2] in message and not (tmp_path / "n").exists()
    assert "--copy-images" in refusal(capsys, run, "colmap", tmp_path / "n", "--copy-images")
    assert "--images" in refusal(capsys, run, "nerfstudio", tmp_path / "n", "--images", "nowhere")


@pytest.mark.parametrize("name", ["a b.jpg", "new\nline.jpg"])
def test_names_that_a_format_would_cut_are_refused(tmp_path, capsys, name):
    names = [name, *NAMES[1:]]
    run = write_run(tmp_path / "run", exact_model([camera("SIMPLE_PINHOLE")], names))
    for to in ("hloc", "colmap-text"):
        assert "has a blank in it" in refusal(capsys, run, to, target(tmp_path, to))
    for to in ("colmap", "nerfstudio"):
        (tmp_path / to).mkdir()
        assert export(run, to, target(tmp_path / to, to)) == 0
    frames = json.loads((tmp_path / "nerfstudio" / "made" / "transforms.json").read_text())
    assert f"images/{name}" in [frame["file_path"] for frame in frames["frames"]]


def test_a_missing_or_damaged_run_is_one_sentence(tmp_path, model, capsys):
    for to in ALL:
        assert "no such folder" in refusal(capsys, tmp_path / "no", to, target(tmp_path, to))
    run = write_run(tmp_path / "run", model)
    (run / "database.db").write_bytes(b"x" * 5000)
    assert "not a readable COLMAP database" in refusal(capsys, run, "hloc", tmp_path / "h")
    for name in ("images.bin", "points3D.bin"):
        (run / "sparse" / "0" / name).write_bytes(b"")
    assert "not a readable COLMAP model" in refusal(capsys, run, "colmap", tmp_path / "h")


def test_the_photos_are_those_of_the_run_unless_others_are_given(run, photos, tmp_path, capsys):
    made = tmp_path / "run"
    shutil.copytree(run, made)
    (made / "report.json").write_text(json.dumps({"images": {"folder": str(photos)}}))
    assert export(made, "nerfstudio", tmp_path / "a") == 0
    frames = json.loads((tmp_path / "a/transforms.json").read_text())["frames"]
    assert all(Path(frame["file_path"]).is_relative_to(photos) for frame in frames)
    assert export(made, "nerfstudio", tmp_path / "b", "--copy-images") == 0
    assert (tmp_path / "b/images").is_dir()
    for text in ("{", "[]", json.dumps({"images": {"folder": str(tmp_path / "gone")}})):
        (made / "report.json").write_text(text)
        assert export(made, "nerfstudio", tmp_path / f"c{len(text)}") == 0
        message = refusal(capsys, made, "nerfstudio", tmp_path / "n", "--copy-images")
        assert "--images" in message


@pytest.mark.parametrize("name", ["../../secret.txt", "/etc/secret.txt", "a/../../b.jpg"])
def test_no_name_of_a_model_leads_out_of_the_photos(name, tmp_path, capsys):
    """A model can come from a stranger; photos are copied by its names."""
    model = exact_model([camera("SIMPLE_PINHOLE")])
    model.image(model.reg_image_ids()[0]).name = name
    folder = tmp_path / "deep" / "model"
    folder.mkdir(parents=True)
    model.write_binary(folder)
    photos = tmp_path / "deep" / "photos"
    photos.mkdir()
    (tmp_path / "secret.txt").write_text("not for export")
    out = tmp_path / "out" / "nerfstudio"
    message = refusal(capsys, folder, "nerfstudio", out, "--images", photos, "--copy-images")
    assert "outside" in message and not out.exists()


def test_a_name_that_the_output_cannot_show_is_printed_as_escapes(tmp_path, run):
    """Windows writes into files and pipes in an encoding with few letters."""
    out = tmp_path / "模型.ply"
    command = [sys.executable, "-m", "jaxsfm", "export", str(run), "--to", "ply", "--out", str(out)]
    known = {"PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0"}
    done = subprocess.run(command, capture_output=True, env=os.environ | known)
    assert done.returncode == 0 and out.is_file()
    assert rb"\u6a21\u578b.ply" in done.stdout
