"""Models on rigs, from exact scenes of COLMAP with noise and wrong matches."""

import dataclasses
import shutil

import numpy as np
import pycolmap
import pytest

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.given_model import has_rigs
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import run_mapper, with_all_points
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.colmap.rigid_model import rigid_models
from jaxsfm.colmap.rigs import clear_rigs, have_common_centre, rigs_of_database
from jaxsfm.errors import UserError

OPTIONS = MapOptions(refine_intrinsics=False, threads=1)
NOISE_PX = 0.3


def scene(folder, *, cameras, frames=5, known=True, base=0.3, wrong=0.05):
    """The exact model of one rig, and a database with noisy keypoints and some wrong matches.

    Rigs and frames are numbered as `write_database` does.

    Args:
      known: whether the database says where cameras are mounted.
    """
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=cameras,
        num_frames_per_rig=frames,
        num_points3D=150,
        camera_has_prior_focal_length=True,
        sensor_from_rig_translation_stddev=base,
        inlier_match_ratio=1 - wrong,
    )
    pycolmap.set_random_seed(0)
    rng, path = np.random.default_rng(0), folder / "scene.db"
    with pycolmap.Database.open(path) as db:
        truth = pycolmap.synthesize_dataset(options, db)
        for image in db.read_all_images():
            xy = db.read_keypoints(image.image_id)[:, :2]
            noisy = (xy + rng.normal(0, NOISE_PX, xy.shape)).astype(np.float32)
            db.update_keypoints(image.image_id, noisy)
        (rig,) = db.read_all_rigs()
        for sensor in rig.non_ref_sensors if not known else ():
            rig.set_sensor_from_rig(sensor, None)
        frames = db.read_all_frames()
        db.clear_frames()
        db.clear_rigs()
        db.write_rig(rig, use_rig_id=True)  # it has the id of its first camera
        for frame in frames:
            first = min(data.id for data in frame.image_ids)
            numbered = pycolmap.Frame(frame_id=first, rig_id=rig.rig_id)
            for data in frame.image_ids:
                numbered.add_data_id(data)
            db.write_frame(numbered, use_frame_id=True)
    return truth, path


def mapped(path, options=OPTIONS):
    alone = path.with_name("alone.db")
    shutil.copyfile(path, alone)
    clear_rigs(alone)
    return rigid_models(run_mapper(alone, options), path, options)


def held(path):
    rigs = rigs_of_database(path)
    return tuple(
        sensor.id
        for rig in rigs.rigs.values()
        for sensor, pose in rig.non_ref_sensors.items()
        if pose is not None
    )


def places(model):
    """Where the cameras of the rig are mounted, by id."""
    (rig,) = (rig for rig in model.rigs.values() if rig.num_sensors() > 1)
    return {sensor.id: pose for sensor, pose in rig.non_ref_sensors.items()}


def assert_rigid(model):
    for frame in model.frames.values():
        for data in frame.image_ids:
            mount = pycolmap.Rigid3d()
            if not model.image(data.id).is_ref_in_frame():
                mount = places(model)[data.sensor_id.id]
            expected = (mount * frame.rig_from_world).matrix()
            np.testing.assert_allclose(model.image(data.id).cam_from_world().matrix(), expected)


def size(model):
    centres = np.stack([i.projection_center() for i in model.images.values() if i.has_pose])
    return np.linalg.norm(centres - centres.mean(0), axis=1).mean()


@pytest.mark.parametrize("cameras", [2, 6])
def test_a_known_base_gives_the_size_and_stays(tmp_path, cameras):
    truth, path = scene(tmp_path, cameras=cameras)
    options = dataclasses.replace(OPTIONS, held=held(path))
    (model,) = mapped(path, options)
    assert model.num_reg_images() == truth.num_reg_images()
    assert_rigid(model)
    for camera, pose in places(model).items():
        np.testing.assert_allclose(pose.matrix(), places(truth)[camera].matrix(), atol=1e-12)
    assert abs(size(model) / size(truth) - 1) < 0.005


@pytest.mark.parametrize("cameras", [2, 6])
def test_places_that_are_not_known_are_estimated(tmp_path, cameras):
    truth, path = scene(tmp_path, cameras=cameras, known=False)
    (model,) = mapped(path)
    assert_rigid(model)
    scale = size(truth) / size(model)
    for camera, pose in places(model).items():
        exact = places(truth)[camera]
        assert np.degrees((pose.rotation * exact.rotation.inverse()).angle()) < 0.05
        off = np.linalg.norm(scale * pose.translation - exact.translation)
        assert off < 0.02 * np.linalg.norm(exact.translation)


def test_cameras_with_one_centre_are_mapped_on_their_rig(tmp_path):
    truth, path = scene(tmp_path, cameras=4, base=0.0)
    assert have_common_centre(rigs_of_database(path))
    options = dataclasses.replace(OPTIONS, held=held(path))
    (model,) = rigid_models(run_mapper(path, options), path, options)
    assert has_rigs(model)
    assert_rigid(model)
    before = size(model)
    bundle_adjust(model, loss_px=1.0, refine_intrinsics=False, threads=1, held=options.held)
    assert size(model) == pytest.approx(before, rel=0.01)
    assert model.num_reg_images() == truth.num_reg_images()
    for camera, pose in places(model).items():
        np.testing.assert_allclose(pose.matrix(), places(truth)[camera].matrix(), atol=1e-12)


def test_a_rigid_model_comes_back_from_arrays_and_with_all_points(tmp_path):
    _, path = scene(tmp_path, cameras=2)
    options = dataclasses.replace(OPTIONS, held=held(path))
    (model,) = mapped(path, options)
    again = Model.from_colmap(model, stored_sizes(model)).to_colmap()
    whole = with_all_points(again, path, options)
    for each in (again, whole):
        assert_rigid(each)
        assert each.num_reg_frames() == model.num_reg_frames()
        assert places(each)[2].matrix() == pytest.approx(places(model)[2].matrix())
    assert whole.num_points3D() >= 0.9 * model.num_points3D()


def test_a_photo_that_the_mapper_lost_follows_its_frame(tmp_path):
    _, path = scene(tmp_path, cameras=2)
    alone = tmp_path / "some.db"
    shutil.copyfile(path, alone)
    clear_rigs(alone)
    options = dataclasses.replace(OPTIONS, held=held(path))
    with pycolmap.Database.open(alone) as db:
        lost = db.read_all_images()[3].name
        names = [image.name for image in db.read_all_images() if image.name != lost]
    free = run_mapper(alone, options, names=names)
    assert lost not in {image.name for image in free[0].images.values()}
    (model,) = rigid_models(free, path, options)
    assert_rigid(model)
    (number,) = (i for i, image in model.images.items() if image.name == lost)
    assert model.image(number).num_points3D == 0
    assert with_all_points(model, path, options).image(number).num_points3D > 50


def test_a_rig_that_is_not_that_of_the_photos_is_named(tmp_path):
    _, path = scene(tmp_path, cameras=2)
    with pycolmap.Database.open(path) as db:
        (rig,) = db.read_all_rigs()
        ((sensor, pose),) = rig.non_ref_sensors.items()
        turned = pycolmap.Rotation3d(np.asarray([0, 0, 0.3])) * pose.rotation
        rig.set_sensor_from_rig(sensor, pycolmap.Rigid3d(turned, pose.translation))
        db.update_rig(rig)
    with pytest.raises(UserError, match="--rig: only .* observations of the camera of .* fit"):
        mapped(path, dataclasses.replace(OPTIONS, held=held(path)))


def test_a_camera_that_no_model_joins_to_its_rig_is_named(tmp_path):
    _, path = scene(tmp_path, cameras=2, known=False)
    alone = tmp_path / "left.db"
    shutil.copyfile(path, alone)
    clear_rigs(alone)
    with pycolmap.Database.open(alone) as db:
        left = [image.name for image in db.read_all_images() if image.camera_id == 1]
    with pytest.raises(UserError, match="--rig: where a camera of the rig of .* is mounted"):
        rigid_models(run_mapper(alone, OPTIONS, names=left), path, OPTIONS)
