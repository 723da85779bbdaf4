"""Reference poses: Strecha's .camera files and COLMAP models."""

import re

import numpy as np
import pycolmap
import pytest

from jaxsfm.bench.synthetic import arc, camera_matrix
from jaxsfm.colmap.model_files import find_model, read_model
from jaxsfm.colmap.poses import CameraPose, model_poses, read_poses
from jaxsfm.errors import UserError


def strecha(pose: CameraPose, *, digits: str = ".17g") -> str:
    """K, a row of zeros, R camera to world, centre, size: as the benchmark has it."""
    rows = [*camera_matrix((640, 480)), np.zeros(3), *pose.rotation.T, pose.centre]
    return "\n".join(" ".join(f"{v:{digits}}" for v in row) for row in rows) + "\n640 480\n"


def synthetic() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=4, num_points3D=30, num_points2D_without_point3D=0
    )
    return pycolmap.synthesize_dataset(options)


def write_model(folder, *, text: bool = False) -> pycolmap.Reconstruction:
    folder.mkdir(parents=True, exist_ok=True)
    model = synthetic()
    (model.write_text if text else model.write_binary)(folder)
    return model


def assert_poses(got, want) -> None:
    assert got.keys() == want.keys()
    for name, pose in want.items():
        np.testing.assert_allclose(got[name].rotation, pose.rotation, atol=1e-12)
        np.testing.assert_allclose(got[name].centre, pose.centre, atol=1e-12)


@pytest.mark.parametrize("sub", ["", "gt_dense_cameras"])
def test_strecha_files_come_back_by_image_name(tmp_path, sub):
    truth = {f"view {i}.png": pose for i, pose in enumerate(arc(4))}
    (tmp_path / sub).mkdir(exist_ok=True)
    for name, pose in truth.items():
        (tmp_path / sub / f"{name}.camera").write_text(strecha(pose))
    assert_poses(read_poses(tmp_path), truth)


def matrix_of(pose: CameraPose) -> np.ndarray:
    """Camera to world, float64 (4, 4)."""
    return np.block([[pose.rotation.T, pose.centre[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.mark.parametrize("colour", [False, True])
def test_poses_of_7_scenes_come_back_by_the_photos_stem(tmp_path, colour):
    truth = {f"frame-{i:06d}": pose for i, pose in enumerate(arc(4))}
    for name, pose in truth.items():
        np.savetxt(tmp_path / f"{name}.pose.txt", matrix_of(pose))
        if colour:
            (tmp_path / f"{name}.color.png").write_bytes(b"")
    names = {f"{name}.color": pose for name, pose in truth.items()} if colour else truth
    assert_poses(read_poses(tmp_path), names)


@pytest.mark.parametrize("text", ["", "1 0 0 0\n0 1 0 0\n0 0 1 0\n", "no pose", "nan " * 4])
def test_a_malformed_pose_is_refused_by_name(tmp_path, text):
    (tmp_path / "frame-000000.pose.txt").write_text(text)
    with pytest.raises(UserError, match="frame-000000.pose.txt: not a pose"):
        read_poses(tmp_path)


def test_a_pose_that_mirrors_is_refused(tmp_path):
    matrix = matrix_of(arc(3)[0]) @ np.diag([-1, 1, 1, 1])
    np.savetxt(tmp_path / "a.pose.txt", matrix)
    with pytest.raises(UserError, match="not a rotation matrix"):
        read_poses(tmp_path)


def test_a_point_before_the_camera_projects_in_front(tmp_path):
    """World to camera: what the demo's cameras look at lies on their optical axis."""
    pose = arc(3)[0]
    (tmp_path / "0.png.camera").write_text(strecha(pose))
    got = read_poses(tmp_path)["0.png"]
    target = got.rotation @ (np.asarray([-0.1, 0.1, 5.2]) - got.centre)
    assert target[2] > 4
    np.testing.assert_allclose(target[:2], 0, atol=1e-9)


GOOD = strecha(arc(3)[0]).split()


def edited(index: int, value: str) -> str:
    return " ".join([*GOOD[:index], value, *GOOD[index + 1 :]])


MIRROR = CameraPose(np.diag([1.0, 1, -1]) @ arc(3)[0].rotation, np.zeros(3))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "not numbers",
        " ".join(GOOD[:23]),
        edited(12, "nan"),
        edited(22, "inf"),
        edited(13, "0.9"),
        "\n".join(GOOD[:12] + 9 * ["0"] + GOOD[21:]),
        strecha(MIRROR),
    ],
    ids=["empty", "words", "short", "nan", "inf", "skewed", "zero rotation", "mirrored"],
)
def test_a_malformed_camera_file_is_refused_by_name(tmp_path, text):
    (tmp_path / "0.png.camera").write_text(strecha(arc(3)[0]))
    (tmp_path / "1.png.camera").write_text(text)
    with pytest.raises(UserError, match=r"1\.png\.camera"):
        read_poses(tmp_path)


def test_a_binary_or_unreadable_camera_file_is_refused(tmp_path):
    (tmp_path / "a.camera").write_bytes(b"\xff\xd8\x00\x80")
    with pytest.raises(UserError, match="a.camera: not a Strecha camera file"):
        read_poses(tmp_path)
    (tmp_path / "a.camera").unlink()
    (tmp_path / "a.camera").mkdir()
    with pytest.raises(UserError, match="a.camera: not a Strecha camera file"):
        read_poses(tmp_path)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("sub", ["", "sparse", "sparse/0"])
def test_a_colmap_model_is_found_in_the_folder_or_below(tmp_path, sub, text):
    model = write_model(tmp_path / sub, text=text)
    poses = read_poses(tmp_path)
    assert_poses(poses, model_poses(model))
    assert len(poses) == 4 and find_model(tmp_path) == tmp_path / sub
    image = next(iter(model.images.values()))
    moved = image.cam_from_world()
    got = poses[image.name]
    np.testing.assert_allclose(got.rotation @ got.centre, -moved.translation, atol=1e-12)


def test_only_registered_images_have_poses():
    model = synthetic()
    lost = model.image(min(model.reg_image_ids()))
    model.deregister_frame(lost.frame_id)
    assert len(model_poses(model)) == 3 and lost.name not in model_poses(model)


def test_a_folder_with_neither_is_refused_naming_the_option(tmp_path):
    (tmp_path / "images").mkdir()
    with pytest.raises(UserError, match=f"{re.escape(str(tmp_path))}: no .camera files"):
        read_poses(tmp_path)
    with pytest.raises(UserError, match="--other .*none: no such folder"):
        read_poses(tmp_path / "none", option="--other")
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="no such folder"):
        read_poses(tmp_path / "file")
    with pytest.raises(UserError, match="no COLMAP model here"):
        find_model(tmp_path)


@pytest.mark.parametrize("damage", ["missing cameras", "empty images", "half images", "words"])
def test_a_damaged_model_is_refused_by_name(tmp_path, damage):
    write_model(tmp_path)
    images = tmp_path / "images.bin"
    data = images.read_bytes()
    if damage == "missing cameras":
        (tmp_path / "cameras.bin").unlink()
    else:
        images.write_bytes(
            {"empty images": b"", "half images": data[: len(data) // 2], "words": b"words"}[damage]
        )
    for read in (read_poses, read_model):
        with pytest.raises(
            UserError, match=f"{re.escape(str(tmp_path))}: not a readable COLMAP model"
        ):
            read(tmp_path)


def write_llff(folder, poses, *, photos="images") -> None:
    """A row of 17 numbers for each photo, in the order of the photos' names."""
    (folder / photos).mkdir(parents=True, exist_ok=True)
    rows = []
    for name, pose in sorted(poses.items()):
        (folder / photos / name).write_bytes(b"")
        right, down, forward = pose.rotation
        matrix = np.stack([down, right, -forward, pose.centre, [480, 640, 500]], axis=1)
        rows.append(np.append(matrix, [0.1, 9.0]))
    np.save(folder / "poses_bounds.npy", np.asarray(rows))


@pytest.mark.parametrize("photos", ["images", ""])
def test_poses_of_llff_come_back_in_the_order_of_the_photos_names(tmp_path, photos):
    truth = {f"{i}.jpg": pose for i, pose in zip("badc", arc(4), strict=True)}
    write_llff(tmp_path, truth, photos=photos)
    assert_poses(read_poses(tmp_path), truth)


def test_a_table_of_llff_that_does_not_fit_the_photos_is_refused(tmp_path):
    write_llff(tmp_path, {f"{i}.jpg": pose for i, pose in enumerate(arc(4))})
    (tmp_path / "images" / "4.jpg").write_bytes(b"")
    with pytest.raises(UserError, match=r"expected 5 rows of 17 finite numbers, got 4 x 17"):
        read_poses(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.asarray([{}], object), allow_pickle=True)
    with pytest.raises(UserError, match=r"poses_bounds\.npy: not a table of poses"):
        read_poses(tmp_path)
    for damaged in (b"", b"PK\x03\x04 no archive"):
        (tmp_path / "poses_bounds.npy").write_bytes(damaged)
        with pytest.raises(UserError, match=r"poses_bounds\.npy: not a table of poses"):
            read_poses(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.full((5, 17), "one"))
    with pytest.raises(UserError, match=r"poses_bounds\.npy: not a table of poses \(no numbers\)"):
        read_poses(tmp_path)


def test_a_model_beside_a_table_of_llff_is_read_because_it_has_names(tmp_path):
    write_llff(tmp_path, {f"{i}.jpg": pose for i, pose in enumerate(arc(4))})
    model = write_model(tmp_path / "sparse" / "0")
    assert_poses(read_poses(tmp_path), model_poses(model))
