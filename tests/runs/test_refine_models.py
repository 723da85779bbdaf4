"""`jaxsfm refine`: models of other tools come closer to the truth, and all else stays."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from room_scene import SIZE, Room, arrays, errors, exact_tracks, noisy_model, other_scene

from jaxsfm.cli.main import main
from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.given_model import has_rigs
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.reconstruction import move_model
from jaxsfm.config import Config, Refinement
from jaxsfm.errors import UserError
from jaxsfm.runs.refine import REPORT, RefineOptions, RefineReport, refine_folder, refine_lines
from jaxsfm.sfm.view_graph import rotation_angle_deg

ONE_PASS = RefineOptions(
    config=Config(refinement=Refinement(passes=1)), refine_intrinsics="no", threads=1
)


def write_photos(folder: Path, images: dict[str, np.ndarray]) -> Path:
    for name, image in images.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.uint8(np.clip(np.round(image), 0, 255)))
    return folder


@pytest.fixture(scope="module")
def photos(tmp_path_factory, rendered) -> Path:
    return write_photos(tmp_path_factory.mktemp("photos"), rendered.images)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory, rendered) -> Path:
    """A binary model whose keypoints have one pixel of noise."""
    folder = tmp_path_factory.mktemp("noisy")
    noisy_model(rendered, 1.0).write_binary(folder)
    return folder


def refined(
    model: Path, photos: Path, out: Path, options: RefineOptions = ONE_PASS
) -> tuple[pycolmap.Reconstruction, RefineReport]:
    report = refine_folder(model, photos, out, options=options)
    assert report is not None
    return read_model(out), report


def write(folder: Path, model: pycolmap.Reconstruction, *, text: bool = False) -> Path:
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(folder)
    return folder


def centre_shift(a: pycolmap.Reconstruction, b: pycolmap.Reconstruction) -> float:
    """The mean distance of common cameras, without any alignment."""
    one, other = model_poses(a), model_poses(b)
    both = one.keys() & other.keys()
    return float(np.mean([np.linalg.norm(one[n].centre - other[n].centre) for n in both]))


# -- what becomes better -----------------------------------------------------------------------


@pytest.mark.parametrize("where", ["", "sparse/0", "colmap/sparse/0", "sfm"])
def test_cameras_come_closer_to_the_truth_wherever_the_model_lies(
    tmp_path, rendered, photos, where
):
    text = where == "sparse/0"
    before = noisy_model(rendered, 1.0)
    write(tmp_path / "in" / where, before, text=text)
    after, report = refined(tmp_path / "in", photos, tmp_path / "out")
    (p0, r0), (p1, r1) = errors(before, rendered), errors(after, rendered)
    assert p1 < p0 / 2 and r1 < r0 / 2
    assert report.before.reprojection_error_px > 0.9
    assert report.after.reprojection_error_px < 0.4
    error = after.compute_mean_reprojection_error()
    assert np.isclose(report.after.reprojection_error_px, error, rtol=1e-9)
    assert report.after.observations == after.compute_num_observations()
    assert report.before.points == before.num_points3D()
    (done,) = report.refinement.passes
    # One pixel of noise in x and in y, in the reference view and in the other one.
    assert 1.0 < done.shift_px < 2.5
    colours = np.asarray([point.color for point in after.points3D.values()])
    assert colours.min() < 100 < colours.max()


@pytest.mark.parametrize("lens", ["OPENCV_FISHEYE", "FULL_OPENCV"])
def test_distorted_photos_are_refined_as_they_are(tmp_path, rendered, lens):
    plain = rendered.views[0].camera
    extra = {
        "OPENCV_FISHEYE": [0.02, -0.01, 0.003, -0.002],
        "FULL_OPENCV": [-0.1, 0.03, 0.002, -0.001, 0.002, 0.01, 0.0, 0.0],
    }[lens]
    params = [*plain.params, *extra]
    camera = pycolmap.Camera(camera_id=1, model=lens, width=SIZE[0], height=SIZE[1], params=params)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    rays = camera.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
    at = plain.img_from_cam(np.c_[rays, np.ones(len(rays))]).reshape(*x.shape, 2) - 0.5
    images = {
        name: cv2.remap(image, np.float32(at), None, cv2.INTER_CUBIC)  # pyright: ignore
        for name, image in rendered.images.items()
    }
    views = [dataclasses.replace(view, camera=camera) for view in rendered.views]
    scene = rendered._replace(views=views, visible=_inside(rendered, views))
    before = noisy_model(scene, 1.0)
    write(tmp_path / "in", before)
    after, _ = refined(tmp_path / "in", write_photos(tmp_path / "p", images), tmp_path / "out")
    assert after.camera(1).model_name == lens
    assert np.array_equal(after.camera(1).params, params)
    assert errors(after, scene)[0] < errors(before, scene)[0] / 2


def _inside(scene: Room, views) -> np.ndarray:
    """The visible points that distorted views still show."""
    visible = scene.visible.copy()
    for k, view in enumerate(views):
        at, _ = view.project(scene.points)
        with np.errstate(invalid="ignore"):
            visible[:, k] &= ((at > 1) & (at < np.asarray(SIZE) - 2)).all(1)
    return visible & (visible.sum(1) >= 2)[:, None]


def test_observations_that_are_far_off_are_first_aligned_in_small_images(
    tmp_path, rendered, photos
):
    """Four pixels of noise are beyond the reach of the alignment at full size."""
    before = noisy_model(rendered, 4.0)
    write(tmp_path / "in", before)
    options = RefineOptions(refine_intrinsics="no", threads=1)
    after, report = refined(tmp_path / "in", photos, tmp_path / "out", options)
    assert len(report.refinement.passes) > 2
    assert errors(after, rendered)[0] < errors(before, rendered)[0] / 4


def test_two_photos_whose_tracks_are_pairs_are_refined(tmp_path, rendered, photos):
    names = ["0.png", "2.png"]
    before = arrays(noisy_model(rendered, 1.0), rendered).part(names)[0].to_colmap()
    bundle_adjust(before, loss_px=2.0, refine_intrinsics=False, threads=1)
    write(tmp_path / "in", before)
    after, report = refined(tmp_path / "in", photos, tmp_path / "out")
    assert report.after.images == 2 and report.after.track_length == 2.0
    turns = []
    for model in (before, after):
        poses = model_poses(model)
        own, truth = (
            each[names[0]].rotation @ each[names[1]].rotation.T for each in (poses, rendered.poses)
        )
        turns.append(rotation_angle_deg(own, truth))
    assert turns[1] < turns[0]
    assert report.after.reprojection_error_px < report.before.reprojection_error_px / 3


# -- what stays --------------------------------------------------------------------------------


def test_ids_names_and_what_has_no_pose_stay(tmp_path, rendered, photos):
    model = noisy_model(rendered, 1.0)
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=7, model="SIMPLE_PINHOLE", width=9, height=9, params=[5, 4, 4])
    )
    model.deregister_frame(model.image(5).frame_id)
    write(tmp_path / "in", model)
    before = read_model(tmp_path / "in")
    after, _ = refined(tmp_path / "in", photos, tmp_path / "out")
    assert set(after.reg_image_ids()) == {1, 2, 3, 4}
    for image_id in after.images:
        one, other = before.image(image_id), after.image(image_id)
        assert (one.name, one.camera_id, one.frame_id) == (
            other.name,
            other.camera_id,
            other.frame_id,
        )
    assert set(after.cameras) == {1, 7} and np.array_equal(after.camera(7).params, [5, 4, 4])


def test_the_model_stays_where_it_was(tmp_path, rendered, photos):
    """As far from the origin, and as large, as a georeferenced one."""
    turn = pycolmap.Rotation3d(np.asarray([0.3, -0.2, 0.5])).matrix()
    truth = noisy_model(rendered, 0.0)
    before = noisy_model(rendered, 0.5)
    for each in (truth, before):
        move_model(each, 40.0, turn, np.asarray([3000.0, -500.0, 70.0]))
    write(tmp_path / "in", before)
    after, _ = refined(tmp_path / "in", photos, tmp_path / "out")
    assert centre_shift(after, before) < 2 * centre_shift(truth, before)
    names = model_poses(before)
    spread = np.std([pose.centre for pose in names.values()], axis=0).sum()
    assert centre_shift(after, before) < 0.01 * spread


def test_cameras_on_a_rig_stay_on_it(tmp_path, rendered, photos):
    """Four photos are two frames of two cameras; the fifth is a frame of its own."""
    single = noisy_model(rendered, 1.0)
    poses = {i: single.image(i).cam_from_world() for i in single.reg_image_ids()}
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    for camera_id in (1, 2):
        model.add_camera(pycolmap.Camera({**single.camera(1).todict(), "camera_id": camera_id}))
    rig.add_ref_sensor(model.camera(1).sensor_id)
    rig.add_sensor(model.camera(2).sensor_id, poses[2] * poses[1].inverse())
    model.add_rig(rig)
    for frame_id, members in enumerate([(1, 2), (3, 4)], 1):
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1, rig_from_world=poses[members[0]])
        images = []
        for camera_id, image_id in enumerate(members, 1):
            image = pycolmap.Image(
                name=single.image(image_id).name,
                camera_id=camera_id,
                image_id=image_id,
                keypoints=np.asarray([p.xy for p in single.image(image_id).points2D]),
            )
            image.frame_id = frame_id
            frame.add_data_id(image.data_id)
            images.append(image)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(frame_id)
    for point in single.points3D.values():
        track = pycolmap.Track()
        for element in point.track.elements:
            if element.image_id != 5:
                track.add_element(element.image_id, element.point2D_idx)
        if track.length() > 1:
            model.add_point3D(point.xyz, track)
    bundle_adjust(model, loss_px=2.0, refine_intrinsics=False, threads=1)
    write(tmp_path / "in", model)
    after, report = refined(tmp_path / "in", photos, tmp_path / "out")
    assert has_rigs(after) and after.num_reg_images() == 4
    relative = [
        (after.image(b).cam_from_world() * after.image(a).cam_from_world().inverse()).matrix()
        for a, b in ((1, 2), (3, 4))
    ]
    np.testing.assert_allclose(relative[0], relative[1], atol=1e-9)
    assert report.after.observations > 500


def test_a_photo_that_is_missing_keeps_its_place(tmp_path, rendered, noisy, photos):
    some = write_photos(tmp_path / "p", {n: i for n, i in rendered.images.items() if n != "2.png"})
    after, report = refined(noisy, some, tmp_path / "out")
    assert list(report.unread) == ["2.png"] and "cannot be read" in report.unread["2.png"]
    assert report.removed == [] and after.num_reg_images() == 5
    image = next(image for image in after.images.values() if image.name == "2.png")
    assert image.num_points3D > 100
    assert errors(after, rendered)[0] < errors(read_model(noisy), rendered)[0]


def test_a_camera_of_one_photo_keeps_its_intrinsics(tmp_path, rendered, photos):
    model = noisy_model(rendered, 1.0)
    own = arrays(model, rendered)
    views = [
        dataclasses.replace(v, camera=pycolmap.Camera({**v.camera.todict(), "camera_id": k}))
        for k, v in enumerate(own.views, 1)
    ]
    write(tmp_path / "in", dataclasses.replace(own, views=views, cameras={}).to_colmap())
    options = RefineOptions(config=ONE_PASS.config, threads=1)
    after, report = refined(tmp_path / "in", photos, tmp_path / "out", options)
    assert not report.refined_intrinsics and len(after.cameras) == 5
    assert all(np.array_equal(c.params, model.camera(1).params) for c in after.cameras.values())


def test_the_orientation_in_the_exif_data_changes_nothing(tmp_path, rendered, noisy):
    """The model counts the pixels of the photos as they are stored."""
    plain, tagged = tmp_path / "plain", tmp_path / "tagged"
    exif = Image.Exif()
    exif[0x0112] = 6
    for folder, more in ((plain, {}), (tagged, {"exif": exif})):
        folder.mkdir()
        for name, image in rendered.images.items():
            pixels = Image.fromarray(np.uint8(np.clip(np.round(image), 0, 255)))
            pixels.save(folder / name, **more)
    one, other = (
        refined(noisy, folder, tmp_path / f"out {folder.name}")[0] for folder in (plain, tagged)
    )
    for name, pose in model_poses(one).items():
        np.testing.assert_array_equal(model_poses(other)[name].centre, pose.centre)


def test_intrinsics_are_refined_unless_they_look_calibrated(tmp_path, rendered, photos):
    model = noisy_model(rendered, 1.0)
    camera, focal = model.camera(1), rendered.views[0].camera.focal_length_x
    assert camera.principal_point_x == camera.width / 2  # as COLMAP guesses it
    camera.params = [1.02 * focal, 1.02 * focal, *camera.params[2:]]
    bundle_adjust(model, loss_px=2.0, refine_intrinsics=False, threads=1)
    write(tmp_path / "guessed", model)
    options = RefineOptions(threads=1)
    after, report = refined(tmp_path / "guessed", photos, tmp_path / "a", options)
    assert report.refined_intrinsics and report.refinement.camera is None
    assert abs(after.camera(1).focal_length_x / focal - 1) < 0.005
    change = report.cameras[1]
    assert change.before[0] == 1.02 * focal and change.after[0] == after.camera(1).params[0]
    camera.params = [*camera.params[:3], camera.params[3] + 0.25]
    camera.params = [camera.params[0], camera.params[1], camera.params[2] + 0.25, camera.params[3]]
    write(tmp_path / "known", model)
    after, report = refined(tmp_path / "known", photos, tmp_path / "b", options)
    assert not report.refined_intrinsics
    assert np.array_equal(after.camera(1).params, camera.params)
    other = report.refinement.camera  # the one that was held is wrong
    assert other is not None and abs(other.params[0] / focal - 1) < 0.01
    assert f"camera: {other.in_words()}" in refine_lines(report)


# -- what is refused ---------------------------------------------------------------------------


def refused(capsys, *arguments) -> str:
    assert main(["refine", *map(str, arguments)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("jaxsfm: ")
    return line


def test_photos_of_another_scene_leave_nothing_behind(tmp_path, rendered, noisy, capsys):
    wrong = write_photos(tmp_path / "p", {n: other_scene(k) for k, n in enumerate(rendered.images)})
    out = tmp_path / "out"
    assert main(["refine", str(noisy), "--images", str(wrong), "--out", str(out)]) == 1
    assert "too few of its points look alike" in capsys.readouterr().err
    assert not out.exists()


def test_the_command_says_what_it_did(tmp_path, noisy, photos, capsys):
    out = tmp_path / "new" / "out"
    arguments = ["--images", str(photos), "--out", str(out), "--passes", "1", "--threads", "1"]
    assert main(["refine", str(noisy), *arguments]) == 0
    printed = capsys.readouterr().out
    plain = json.loads((out / REPORT).read_text())
    for figures in (plain["before"], plain["after"]):
        assert str(figures["observations"]) in printed
        assert f"{figures['reprojection_error_px']:.3f}" in printed
    assert "pass 1: " in printed and "pass 2" not in printed
    assert plain["settings"]["passes"] == 1 and plain["refined_intrinsics"]


def test_bad_input_is_refused_in_one_sentence(tmp_path, rendered, noisy, photos, capsys):
    whole = read_model(noisy)
    good = [noisy, "--images", photos, "--out", tmp_path / "out"]

    def of(model: Path, images: Path = photos) -> str:
        return refused(capsys, model, "--images", images, "--out", tmp_path / "out")

    assert "no such folder" in of(tmp_path / "none")
    assert "no COLMAP model here" in of(photos)
    cut = write(tmp_path / "cut", whole)
    data = (cut / "points3D.bin").read_bytes()
    (cut / "points3D.bin").write_bytes(data[: len(data) // 2])
    assert "points3D.bin: it ends too early" in of(cut)
    (cut / "points3D.bin").unlink()
    assert "points3D.bin is missing" in of(cut)
    empty = pycolmap.Reconstruction(whole)
    empty.delete_all_points2D_and_points3D()
    assert "no points that two images observe" in of(write(tmp_path / "empty", empty))
    one = pycolmap.Reconstruction(whole)
    for frame_id in list(one.reg_frame_ids())[1:]:
        one.deregister_frame(frame_id)
    assert "1 images with a pose" in of(write(tmp_path / "one", one))
    assert "360-degree" in of(write(tmp_path / "round", _spherical(rendered)))
    blank = write(tmp_path / "blank", whole, text=True)
    text = (blank / "images.txt").read_text().replace(" 3.png", " my 3.png")
    (blank / "images.txt").write_text(text)
    assert "'my 3.png' has a blank in it" in of(blank)
    assert "0 of the model's 5 photos" in of(noisy, tmp_path / "cut")
    small = {n: cv2.resize(i, (240, 180)) for n, i in rendered.images.items()}
    line = of(noisy, write_photos(tmp_path / "small", small))
    assert "0.png has 240 x 180 pixels" in line and "480 x 360" in line
    turned = {n: np.rot90(i) for n, i in rendered.images.items()}
    assert "turned upright" in of(noisy, write_photos(tmp_path / "turned", turned))
    assert "--passes must be at least 1" in refused(capsys, *good, "--passes", 0)
    assert "--max-size must be at least" in refused(capsys, *good, "--max-size", 3)
    assert "--threads" in refused(capsys, *good, "--threads", 0)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    assert "not empty" in refused(capsys, *good)


def _spherical(scene: Room) -> pycolmap.Reconstruction:
    model = Model(scene.views, exact_tracks(scene)).to_colmap()
    round_camera = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, *SIZE)
    other = pycolmap.Reconstruction()
    other.add_camera_with_trivial_rig(round_camera)
    for image in model.images.values():
        new = pycolmap.Image(name=image.name, camera_id=1, image_id=image.image_id)
        other.add_image_with_trivial_frame(new, image.cam_from_world())
    return other


def test_a_photo_that_cannot_be_decoded_counts_as_missing(tmp_path, rendered, noisy):
    some = write_photos(tmp_path / "p", rendered.images)
    data = bytearray((some / "1.png").read_bytes())
    data[len(data) // 3 :] = bytes(len(data) - len(data) // 3)
    (some / "1.png").write_bytes(data)
    try:
        _, report = refined(noisy, some, tmp_path / "out")
    except UserError:
        pytest.fail("one damaged photo must not end the refinement")
    assert list(report.unread) == ["1.png"]
