"""Aachen Day-Night in its own layout, made of the rendered room: no photo of Aachen is at hand."""

import shutil

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from jaxsfm.bench import scenes
from jaxsfm.bench.aachen import PAIRS, aachen_scene, read_nvm
from jaxsfm.bench.scenes import Subset
from jaxsfm.cli.main import main
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import read_images, write_database
from jaxsfm.colmap.poses import CameraPose, read_poses
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.sfm.evaluation import pose_error

SIZE = (320, 240)
QUERY = "query/night/nexus5x/view3_night.png"
QUERIES = "queries/night_time_queries_with_intrinsics.txt"


def colmap_model(poses, focal):
    """A model without points; each image has a camera of its own."""
    model = pycolmap.Reconstruction()
    for k, (name, pose) in enumerate(sorted(poses.items()), 1):
        params = [focal + k, SIZE[0] / 2, SIZE[1] / 2, 0.001 * k]
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=params, camera_id=k
        )
        model.add_camera_with_trivial_rig(camera)
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), -pose.rotation @ pose.centre)
        image = pycolmap.Image(name=name, camera_id=k, image_id=k)
        model.add_image_with_trivial_frame(image, rigid)
    return model


@pytest.fixture(scope="module")
def truth(simple):
    """The exact poses by the names in Aachen's layout."""
    found = read_poses(simple / "room" / "reference")
    return {QUERY if "night" in name else f"db/{name}": pose for name, pose in found.items()}


@pytest.fixture(scope="module")
def folder(simple, truth, tmp_path_factory):
    root = tmp_path_factory.mktemp("aachen")
    photos = root / scenes.PHOTOS
    shutil.copytree(simple / "room" / "day", photos / "db")
    (photos / QUERY).parent.mkdir(parents=True)
    (night,) = (simple / "room" / "night").iterdir()
    shutil.copy(night, photos / QUERY)
    day = {name: pose for name, pose in truth.items() if name != QUERY}
    (root / "3D-models" / "aachen_v_1_1").mkdir(parents=True)
    colmap_model(day, 320.0).write_binary(str(root / "3D-models" / "aachen_v_1_1"))
    (root / "queries").mkdir()
    (root / QUERIES).write_text(f"{QUERY} SIMPLE_RADIAL 320 240 320 160 120 0\n")
    names = sorted(day)
    lines = [*(f"{name} {QUERY}" for name in names), f"{names[0]} {names[1]}"]
    (root / PAIRS).write_text("\n".join(lines))
    return root


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "aachen")


def test_each_night_photo_has_the_day_photos_of_its_lines(folder, truth):
    made = aachen_scene(folder)
    day = sorted(name for name in truth if name != QUERY)
    assert made.subsets == [Subset(day, QUERY)] and set(made.truth) == set(day)
    assert list(scenes.find_scenes(folder, None)) == [folder.name]


def test_a_file_of_subsets_takes_the_place_of_the_pairs(folder, truth, tmp_path):
    day = sorted(name for name in truth if name != QUERY)
    (tmp_path / "subsets.txt").write_text(f"# one of 98\n{QUERY} {day[2]} {day[0]} {day[1]}\n")
    assert aachen_scene(folder, tmp_path / "subsets.txt").subsets == [Subset(day[:3], QUERY)]


def test_cameras_are_those_of_the_lists_and_else_of_the_model(copy):
    cameras = aachen_scene(copy).camera
    assert cameras[QUERY].params == (320, 160, 120, 0)
    assert [cameras[name].params[0] for name in sorted(cameras) if name != QUERY] == [
        321,
        322,
        323,
        324,
    ]
    name = min(cameras)
    (copy / "database_intrinsics.txt").write_text(f"{name} PINHOLE 320 240 300 301 160 120\n")
    changed = aachen_scene(copy).camera
    assert changed[name].model == "PINHOLE" and changed[name].params == (300, 301, 160, 120)
    assert {n: c for n, c in changed.items() if n != name} == {
        n: c for n, c in cameras.items() if n != name
    }


def test_an_nvm_file_holds_the_same_poses(copy, truth):
    rows = []
    for name, pose in truth.items():
        x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat()
        values = [w, x, y, z, *pose.centre]
        rows.append(f"{name} 320 {' '.join(f'{v:.12g}' for v in values)} 0 0")
    path = copy / "3D-models" / "aachen_cvpr2018_db.nvm"
    path.write_text("\n".join(["NVM_V3", "", str(len(rows)), *rows, "0"]))
    for name, pose in read_nvm(path).items():
        error = pose_error(pose, truth[name])
        assert error.position < 1e-9 and error.rotation_deg < 1e-5
    shutil.rmtree(copy / "3D-models" / "aachen_v_1_1")
    lines = [f"{name} SIMPLE_RADIAL 320 240 320 160 120 0\n" for name in truth]
    (copy / "3D-models" / "database_intrinsics.txt").write_text("".join(lines))
    assert set(aachen_scene(copy).truth) == set(truth)


def test_databases_hold_the_known_camera_of_each_photo(folder, tmp_path):
    made = aachen_scene(folder)
    images = list(made.images.values())
    write_database(tmp_path / "ours.db", images, {}, Cameras(known=made.camera))
    verification = VerificationOptions(threads=1)
    write_rootsift_database(
        tmp_path / "rootsift.db",
        made.folder,
        images,
        Cameras(known=made.camera),
        verification,
        pairs=[],
    )
    for name in ("ours.db", "rootsift.db"):
        found = read_images(tmp_path / name)
        assert found.keys() == made.images.keys()
        for image, (_, camera) in found.items():
            assert tuple(camera.params) == made.camera[image].params
            assert camera.has_prior_focal_length


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        (QUERIES, None, ["no intrinsics of", QUERY]),
        (QUERIES, f"{QUERY} SIMPLE_RADIAL 320 240 320 160", ["NAME MODEL WIDTH HEIGHT"]),
        (QUERIES, f"{QUERY} SIMPLE_RADIAL 640 480 320 160 120 0", ["320 x 240", "640 x 480"]),
        (QUERIES, f"{QUERY} SIMPLE_RADIAL 320 240 320 900 120 0", ["principal point"]),
        (QUERIES, b"\xff\xfe", ["cannot be read"]),
        (PAIRS, "a b", ["must name night photos"]),
        (PAIRS, None, ["cannot be read"]),
        (f"{scenes.PHOTOS}/{QUERY}", None, [QUERY]),
        (f"{scenes.PHOTOS}/{QUERY}", b"no image", [QUERY]),
        ("3D-models/aachen_v_1_1", None, ["no COLMAP model and no NVM file"]),
        ("3D-models/aachen_v_1_1/images.bin", b"no model", ["not a readable COLMAP model"]),
    ],
)
def test_damaged_data_are_named_before_the_first_run(copy, capsys, file, text, words):
    path = copy / file
    if text is None:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    else:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert main(["bench", "daynight", "--root", str(copy), "--methods", "paper"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxsfm: ") and "Traceback" not in error
    assert "--intrinsics" not in error  # which was not given
    for word in words:
        assert word in error


@pytest.mark.parametrize("text", ["", "NVM_V2\n\n1\n", "NVM_V3\n\nmany\n", "NVM_V3\n\n1\na 1 2\n"])
def test_what_is_no_nvm_file_is_named(copy, capsys, text):
    shutil.rmtree(copy / "3D-models" / "aachen_v_1_1")
    (copy / "3D-models" / "a.nvm").write_text(text)
    assert main(["bench", "daynight", "--root", str(copy), "--methods", "paper"]) == 2
    assert "a.nvm is not an NVM file" in capsys.readouterr().err


@pytest.mark.slow
def test_the_servers_file_has_the_pose_of_the_night_photo(folder, truth, tmp_path, capsys):
    """The pose of the night photo is not in the data; the file has it in the reference's frame."""
    args = ["bench", "daynight", "--root", str(folder), "--methods", "paper", "--threads", "1"]
    assert main([*args, "--poses", str(tmp_path)]) == 0
    assert "98 subsets do not come with the data" in capsys.readouterr().out
    (line,) = (tmp_path / "Aachen_eval_paper.txt").read_text().splitlines()
    name, *values = line.split()
    w, x, y, z, *t = map(float, values)
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    error = pose_error(CameraPose(rotation, -rotation.T @ np.asarray(t)), truth[QUERY])
    assert name == "view3_night.png" and np.isclose(np.linalg.norm([w, x, y, z]), 1)
    assert error.position < 0.1 and error.rotation_deg < 2
