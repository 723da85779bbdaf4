"""`jaxsfm merge`: two models of parts of a scene become one, or are refused in a sentence."""

import dataclasses
import json

import numpy as np
import pycolmap
import pytest
from room_scene import SIZE, arrays, errors, noisy_model

from jaxsfm.cli.main import main
from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.reconstruction import move_model
from jaxsfm.runs.merge import REPORT, merge_folders

FIRST, SECOND = ["0.png", "1.png", "2.png", "3.png"], ["1.png", "2.png", "3.png", "4.png"]
TURN = pycolmap.Rotation3d(np.asarray([0.4, -1.2, 0.7])).matrix()


def noisy_part(scene, names, *, turned=(), cameras=None) -> pycolmap.Reconstruction:
    """A model of some photos, with their keypoints of the whole model, adjusted by itself.

    Args:
      turned: photos whose pose is wrong by 10 degrees.
      cameras: by name, the id of its camera; None: 1.
    """
    whole = arrays(noisy_model(scene, 0.5), scene)
    views = []
    for view in whole.views:
        if cameras:
            params = {**view.camera.todict(), "camera_id": cameras[view.name]}
            view = dataclasses.replace(view, camera=pycolmap.Camera(params))
        views.append(view)
    model = dataclasses.replace(whole, views=views, cameras={}).part(names)[0]
    made = model.to_colmap()
    bundle_adjust(made, loss_px=1.0, refine_intrinsics=False, threads=1)
    for image in made.images.values():
        if image.name in turned:
            by = pycolmap.Rotation3d(np.radians([0.0, 10.0, 0.0]))
            pose = pycolmap.Rigid3d(by, np.zeros(3)) * image.cam_from_world()
            image.frame.set_cam_from_world(image.camera_id, pose)
    for point in made.points3D.values():
        point.color = np.asarray([200, 100, 50], np.uint8)
    return made


def write(folder, model):
    folder.mkdir()
    model.write_binary(folder)
    return folder


def moved(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    move_model(model, 7.0, TURN, np.asarray([20.0, -3.0, 11.0]))
    return model


def merged(tmp_path, first, second):
    a, b = write(tmp_path / "a", first), write(tmp_path / "b", second)
    report = merge_folders(a, b, tmp_path / "out", threads=1)
    return read_model(tmp_path / "out"), report


def test_two_parts_become_the_whole(tmp_path, rendered):
    first, second = noisy_part(rendered, FIRST), moved(noisy_part(rendered, SECOND))
    whole = noisy_model(rendered, 0.5)
    model, report = merged(tmp_path, first, second)
    assert model.num_reg_images() == 5 and report.shared == 3
    assert errors(model, rendered)[0] < 1.3 * errors(whole, rendered)[0]
    # Points that both have are one point, and no photo observes a point twice.
    assert report.agreed > 0.95 * report.common > 300
    assert abs(model.num_points3D() - whole.num_points3D()) < 0.02 * whole.num_points3D()
    assert model.compute_num_observations() > 0.97 * whole.compute_num_observations()
    for point in model.points3D.values():
        images = [element.image_id for element in point.track.elements]
        assert len(set(images)) == len(images)
        assert tuple(point.color) == (200, 100, 50)
    # It lies where the first model does, whose ids stay; the new photo shares the camera.
    own, other = model_poses(first), model_poses(model)
    for name in FIRST:
        assert np.linalg.norm(own[name].centre - other[name].centre) < 0.02
    for image_id, image in first.images.items():
        assert model.image(image_id).name == image.name
    assert set(model.cameras) == {1}


def test_a_camera_that_no_shared_photo_has_gets_a_new_id(tmp_path, rendered):
    cameras = {name: k + 1 for k, name in enumerate(FIRST)} | {"4.png": 3}
    first = noisy_part(rendered, FIRST, cameras=cameras)
    second = noisy_part(rendered, ["1.png", "2.png", "4.png"], cameras={**cameras, "2.png": 9})
    model, _ = merged(tmp_path, first, second)
    ids = {image.name: image.camera_id for image in model.images.values()}
    assert ids == {**cameras, "4.png": 5}


def test_a_shared_photo_that_lies_elsewhere_is_named_and_does_not_turn_the_rest(tmp_path, rendered):
    first = noisy_part(rendered, FIRST)
    second = moved(noisy_part(rendered, SECOND, turned=["2.png"]))
    model, report = merged(tmp_path, first, second)
    assert report.elsewhere == ["2.png"]
    assert errors(model, rendered)[0] < 0.02


def refused(tmp_path, capsys, first, second) -> str:
    a, b = write(tmp_path / "a", first), write(tmp_path / "b", second)
    assert main(["merge", str(a), str(b), "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"jaxsfm: {a} and {b}: ") and not (tmp_path / "out").exists()
    return line


def test_models_that_share_one_photo_are_refused(tmp_path, rendered, capsys):
    parts = noisy_part(rendered, ["0.png", "1.png"]), noisy_part(rendered, ["1.png", "2.png"])
    assert "share 1 photos by name" in refused(tmp_path, capsys, *parts)


@pytest.mark.parametrize("kind", ["another scene", "other keypoints"])
def test_models_that_do_not_agree_are_refused(tmp_path, rendered, capsys, kind):
    first, second = noisy_part(rendered, FIRST), noisy_part(rendered, SECOND)
    sizes = {view.name: (SIZE, (1.0, 1.0)) for view in rendered.views}
    model = Model.from_colmap(second, sizes)
    if kind == "another scene":  # the same keypoints belong to other places
        mixed = np.random.default_rng(0).permutation(len(model.tracks.points))
        changed = model.tracks._replace(points=model.tracks.points[mixed])
    else:
        noise = np.random.default_rng(0).uniform(3, 40, model.tracks.xy.shape)
        changed = model.tracks._replace(xy=model.tracks.xy + noise)
    line = refused(tmp_path, capsys, first, model.with_tracks(changed).to_colmap())
    assert "do not agree" in line


def test_the_command_says_what_it_joined(tmp_path, rendered, capsys):
    a = write(tmp_path / "a", noisy_part(rendered, FIRST))
    b = write(tmp_path / "b", noisy_part(rendered, SECOND))
    assert main(["merge", str(a), str(b), "--out", str(tmp_path / "out"), "--threads", "1"]) == 0
    printed = capsys.readouterr().out
    plain = json.loads((tmp_path / "out" / REPORT).read_text())
    assert "share 3 photos" in printed and str(plain["agreed"]) in printed
    assert str(plain["after"]["observations"]) in printed
    assert main(["merge", str(a), str(b), "--out", str(tmp_path / "out")]) == 2
    assert "not empty" in capsys.readouterr().err
