"""`--georeference`: a run in metres, what continues from it, and tables that cannot be used."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
import pytest
from kept_runs import change_report
from PIL import ExifTags, Image
from test_localize import POSE, POSITION, SIZE, write

from jaxsfm.bench.synthetic import render, room
from jaxsfm.cli.main import main
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import model_poses, read_poses
from jaxsfm.errors import UserError
from jaxsfm.io.images import inspect_image
from jaxsfm.report.finished_run import read_run
from jaxsfm.report.page.write import page
from jaxsfm.report.scene import shown_scene
from jaxsfm.runs.georeferencing import measured_positions
from jaxsfm.sfm import mapped_stage, refined_stage

METRES = 10.0
UPRIGHT = np.asarray([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""The room has y downwards; the table has z upwards."""
HOME = np.asarray([200.0, -300.0, 50.0])


def in_metres(centre: np.ndarray) -> np.ndarray:
    return METRES * UPRIGHT @ centre + HOME


class Placed(NamedTuple):
    run: Path
    table: Path
    report: dict


def again(plain: Path, scene: Path, *options: str) -> int:
    """Repeat the plain run in a folder with other options."""
    known = ["--intrinsics", str(scene / "K.txt"), "--threads", "1"]
    return main(["reconstruct", str(scene / "images"), "--out", str(plain), *known, *options])


@pytest.fixture(scope="module")
def placed(plain, scene, tmp_path_factory) -> Placed:
    """The plain run, moved onto a table of positions. Nothing but the move is computed."""
    folder = tmp_path_factory.mktemp("placed")
    run, table = folder / "run", folder / "positions.csv"
    shutil.copytree(plain[0], run)
    poses = read_poses(scene / "reference")
    rows = [[name, *map(repr, in_metres(pose.centre).tolist())] for name, pose in poses.items()]
    table.write_text("\n".join(",".join(row) for row in [["image", "x", "y", "z"], *rows]))

    def never(*_args, **_kwargs):
        raise AssertionError("a stage was computed again")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mapped_stage, "verify", never)
        patch.setattr(mapped_stage.Mapper, "map", never)
        patch.setattr(refined_stage, "refine_models", never)
        options = ["--georeference", str(table), "--reference", str(scene / "reference")]
        assert again(run, scene, *options) == 0
    return Placed(run, table, json.loads((run / "report.json").read_text()))


def test_the_model_stands_where_the_table_says(placed, scene):
    poses = model_poses(read_model(placed.run / "sparse" / "0"))
    for name, pose in read_poses(scene / "reference").items():
        assert np.linalg.norm(poses[name].centre - in_metres(pose.centre)) < METRES * POSITION
        turned = pose.rotation @ UPRIGHT.T
        assert np.abs(poses[name].rotation - turned).max() < 0.05


def test_the_report_says_how_and_how_well(placed):
    found = placed.report["georeference"]
    assert (found["source"], found["file"]) == ("positions", str(placed.table))
    assert found["frame"]["axes"] == "x, y, z" and found["frame"]["offset"] == [0, 0, 0]
    (model,) = found["models"]
    assert [row["name"] for row in model["anchors"]] == sorted(placed.report["models"][0]["images"])
    assert 0 < model["residual"]["total"] < METRES * POSITION
    assert model["held_out"] is None  # two positions determine no move
    shown = (placed.run / "report.html").read_text()
    assert 'id="where"' in shown and "Moved onto: 3 of 3 positions" in shown


def test_the_errors_against_a_reference_do_not_depend_on_the_move(placed, plain, scene, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(plain[0], out)
    assert again(out, scene, "--reference", str(scene / "reference")) == 0
    before = json.loads((out / "report.json").read_text())["evaluation"]
    for name, error in placed.report["evaluation"]["images"].items():
        assert error == pytest.approx(before["images"][name], rel=1e-6)


def test_off_gives_the_model_of_the_mapper_to_the_byte(placed, plain, scene, tmp_path):
    assert "georeference" not in plain[1]  # auto, and the photos have no GPS
    out = tmp_path / "run"
    shutil.copytree(placed.run, out)
    assert again(out, scene, "--georeference", "off") == 0
    for file in (plain[0] / "sparse" / "0").iterdir():
        assert (out / "sparse" / "0" / file.name).read_bytes() == file.read_bytes()
    with pycolmap.Database.open(out / "database.db") as db:
        assert db.num_pose_priors() == 0


def test_the_database_has_the_positions_in_the_frame_of_the_model(placed, scene):
    poses = read_poses(scene / "reference")
    with pycolmap.Database.open(placed.run / "database.db") as db:
        names = {image.data_id: image.name for image in db.read_all_images()}
        for prior in db.read_all_pose_priors():
            centre = poses[names.pop(prior.corr_data_id)].centre
            np.testing.assert_allclose(prior.position, in_metres(centre))
    assert not names


def test_the_page_shows_the_model_as_it_stands(placed):
    run = dataclasses.replace(read_run(placed.run), reference=None)
    assert run.model is not None
    stands = np.asarray([view.centre for view in run.model.views])
    shown = np.asarray([camera.pose.centre for camera in shown_scene(run).cameras])
    np.testing.assert_allclose(shown - shown[0], stands - stands[0], atol=1e-9)
    assert "in metres, and the third one points up" in page(run)


@pytest.mark.parametrize("to", ["colmap", "colmap-text", "nerfstudio"])
def test_an_export_says_where_the_model_is(placed, tmp_path, to):
    out = tmp_path / "export"
    assert main(["export", str(placed.run), "--to", to, "--out", str(out)]) == 0
    found = json.loads((out / "georeference.json").read_text())
    assert found["frame"] == placed.report["georeference"]["frame"]
    assert found["models"][0]["similarity"]["scale"] > 0


def test_an_export_of_an_unmoved_run_says_nothing(plain, tmp_path):
    assert main(["export", str(plain[0]), "--to", "colmap", "--out", str(tmp_path / "e")]) == 0
    assert not (tmp_path / "e" / "georeference.json").exists()


def test_exports_are_in_metres(placed, tmp_path):
    centres = {n: p.centre for n, p in model_poses(read_model(placed.run / "sparse/0")).items()}
    out = tmp_path / "nerfstudio"
    assert main(["export", str(placed.run), "--to", "nerfstudio", "--out", str(out)]) == 0
    frames = json.loads((out / "transforms.json").read_text())
    applied = np.asarray(frames["applied_transform"])[:, :3]
    for frame in frames["frames"]:
        at = applied.T @ np.asarray(frame["transform_matrix"])[:3, 3]
        np.testing.assert_allclose(at, centres[Path(frame["file_path"]).name], atol=1e-6)


@pytest.mark.slow
def test_localize_and_extend_stay_in_metres(placed, scene, tmp_path):
    run, photos = tmp_path / "run", tmp_path / "photos"
    shutil.copytree(placed.run, run)
    shutil.copytree(scene / "images", photos)
    new = write(tmp_path / "new.png", render(room(), POSE, SIZE))
    assert main(["localize", str(new), "--model", str(run), "--out", str(tmp_path / "l.json")]) == 0
    (row,) = json.loads((tmp_path / "l.json").read_text())["photos"]
    assert np.linalg.norm(row["centre"] - in_metres(POSE.centre)) < METRES * POSITION
    shutil.copy(new, photos / "new.png")
    change_report(run, lambda report: report["images"].update(folder=str(photos)))
    before = model_poses(read_model(run / "sparse" / "0"))
    assert main(["extend", str(run)]) == 0
    after = model_poses(read_model(run / "sparse" / "0"))
    assert np.linalg.norm(after["new.png"].centre - in_metres(POSE.centre)) < METRES * POSITION
    for name, pose in before.items():
        np.testing.assert_allclose(after[name].centre, pose.centre, atol=1e-9)
    kept = json.loads((run / "report.json").read_text())["georeference"]
    assert kept == placed.report["georeference"]


# -- what is asked for, before the work ------------------------------------------------------------


def gps_photos(folder: Path, places: list[tuple[float, float, float | None]]) -> list:
    tags = ExifTags.GPS
    made = []
    for k, (lat, lon, alt) in enumerate(places):
        exif = Image.Exif()
        fields = {
            tags.GPSLatitudeRef: "N",
            tags.GPSLatitude: (float(int(lat)), (lat % 1) * 60, 0.0),
            tags.GPSLongitudeRef: "E",
            tags.GPSLongitude: (float(int(lon)), (lon % 1) * 60, 0.0),
        }
        if alt is not None:
            fields[tags.GPSAltitude] = alt
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(fields)
        pixels = np.full((64, 64, 3), k, np.uint8)
        Image.fromarray(pixels).save(folder / f"{k}.jpg", exif=exif)
        made.append(inspect_image(folder / f"{k}.jpg", name=f"{k}.jpg"))
    return made


PLACES = [(48.0, 9.0, 300.0), (48.001, 9.0, 301.0), (48.0, 9.001, 302.0)]


def test_gps_and_auto_read_the_positions_in_photos(tmp_path):
    images = gps_photos(tmp_path, PLACES)
    for choice, sure in (("auto", True), ("gps", False)):
        found = measured_positions(choice, images)
        assert found is not None and found.source == "gps" and found.sure is sure
        local = found.local(found.frame())
        assert local["1.jpg"].y - local["0.jpg"].y == pytest.approx(111.2, abs=0.2)
    assert measured_positions("off", images) is None


def test_positions_that_say_nothing_are_as_none(tmp_path):
    images = gps_photos(tmp_path, [PLACES[0]] * 4)
    assert measured_positions("auto", images) is None
    with pytest.raises(UserError, match="gps: 0 photos have a GPS position"):
        measured_positions("gps", images)


def refusal(capsys, *args: str) -> str:
    capsys.readouterr()
    assert main(["reconstruct", *args]) == 2
    (line,) = [
        line
        for line in capsys.readouterr().err.strip().splitlines()
        if line.startswith("jaxsfm: --georeference")
    ]
    return line


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("image,x,y,z\nother1.png,1,2,3\n", "0 photos of the folder have a position"),
        ("image,lat,lon,alt\nview0.png,91,2,3\n", "its latitude in -90 .. 90"),
        ("WGS84 UTM 32N\n500000 5000000 3 5000 10 view0.png A\n", "lies outside view0.png"),
        (
            "WGS84 UTM 32N\n500000 5000000 3 50 10 view0.png A\n"
            "500000 5000000 3 60 10 view2.png A\n",
            "1 control points have a height and are measured in two photos",
        ),
        ("EPSG:999999\n1 2 3 4 5 view0.png A\n", "no known coordinate system"),
        ("nonsense\n", "the first line must name a coordinate system"),
        ("image,x,y,z\nview0.png,1,2\n", "line 2: must have 4 fields"),
    ],
)
def test_a_table_that_cannot_be_used_stops_the_run_before_its_work(
    scene, tmp_path, capsys, text, says
):
    pytest.importorskip("pyproj")
    table = tmp_path / "table.txt"
    table.write_text(text)
    out = tmp_path / "out"
    args = [str(scene / "images"), "--out", str(out), "--georeference", str(table)]
    assert says in refusal(capsys, *args)
    assert not out.exists()


def test_a_choice_that_is_no_file_and_gps_without_gps_are_refused(scene, tmp_path, capsys):
    args = [str(scene / "images"), "--out", str(tmp_path / "out"), "--georeference"]
    assert "no such file, and not auto, off or gps" in refusal(capsys, *args, "gsp")
    assert "0 photos have a GPS position with an altitude" in refusal(capsys, *args, "gps")


def test_without_pyproj_a_projection_says_what_to_install(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    table = tmp_path / "gcp_list.txt"
    table.write_text("WGS84 UTM 32N\n500000 5000000 3 50 10 view0.png A\n")
    args = [str(scene / "images"), "--out", str(tmp_path / "out"), "--georeference", str(table)]
    assert "pip install 'jaxsfm[geo]'" in refusal(capsys, *args)
