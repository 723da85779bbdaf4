"""Laws of databases with a part of the inliers, and of models that get the points of all."""

import shutil

import numpy as np
import pycolmap
import pytest
from databases import content
from mapped import verified

from jaxsfm.colmap import mapper
from jaxsfm.colmap.database import read_images, read_matches, write_database
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import run_mapper, with_all_points
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.reconstruction import registered, take_out
from jaxsfm.colmap.two_views import keep_inliers, read_inliers
from jaxsfm.errors import UserError

ONE = MapOptions(refine_intrinsics=False, threads=1)


@pytest.fixture
def database(tmp_path, scene):
    path = tmp_path / "d.db"
    write_database(path, scene.images, scene.results, scene.cameras)
    verified(path, ONE)
    return path


@pytest.fixture
def few(tmp_path, database):
    """A database with every fifth inlier."""
    path = tmp_path / "few.db"
    shutil.copyfile(database, path)
    keep_inliers(path, {pair: rows[::5] for pair, rows in read_inliers(path).matches.items()})
    return path


def test_inliers_are_those_of_the_database(database):
    inliers = read_inliers(database)
    cameras = read_images(database)
    assert len(inliers.matches) == 10 and inliers.keypoints.keys() == cameras.keys()
    for (a, b), rows in inliers.matches.items():
        seen = [inliers.keypoints[name].xy[rows[:, k]] for k, name in enumerate((a, b))]
        for ours, theirs in zip(seen, read_matches(database, (a, b), verified=True), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    for name, (_, camera) in cameras.items():
        assert inliers.keypoints[name].size == (camera.width, camera.height)


@pytest.mark.parametrize("columns", [2, 4, 6])
def test_keypoints_of_any_number_of_columns_lie_where_the_first_two_say(tmp_path, columns):
    """Those of COLMAP's SIFT have six. Read as pairs of numbers, they would be three times as many,
    and the frames that RootSIFT localizes were kilometres off."""
    import pycolmap

    path, rows = tmp_path / "d.db", np.float32(np.arange(5 * columns).reshape(5, columns))
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=64, height=48, params=[60, 32, 24])
    with pycolmap.Database.open(path) as db:
        camera_id = db.write_camera(camera)
        number, bare = (
            db.write_image(pycolmap.Image(name=n, camera_id=camera_id)) for n in ("a", "bare")
        )
        db.write_keypoints(number, rows)
        db.write_keypoints(bare, rows[:0])
    found = read_inliers(path).keypoints
    np.testing.assert_array_equal(found["a"].xy, rows[:, :2] - 0.5)
    assert found["bare"].xy.shape == (0, 2)


def test_a_pair_of_images_that_were_written_in_another_order_is_turned_round(tmp_path):
    import pycolmap

    path = tmp_path / "d.db"
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=64, height=48, params=[60, 32, 24])
    with pycolmap.Database.open(path) as db:
        camera_id = db.write_camera(camera)
        ids = {n: db.write_image(pycolmap.Image(name=n, camera_id=camera_id)) for n in "ba"}
        for name in "ab":
            db.write_keypoints(ids[name], np.zeros((9, 2), np.float32))
        rows = np.asarray([[1, 5], [2, 7]], np.uint32)  # of b and a
        geometry = pycolmap.TwoViewGeometry(config=2, inlier_matches=rows)
        db.write_two_view_geometry(ids["b"], ids["a"], geometry)
    assert read_inliers(path).matches["a", "b"].tolist() == [[5, 1], [7, 2]]
    keep_inliers(path, {("a", "b"): np.asarray([[7, 2]])})
    assert read_inliers(path).matches["a", "b"].tolist() == [[7, 2]]


def test_kept_inliers_are_all_that_changes(database, few):
    whole, part = (content(path) for path in (database, few))
    for table in whole.keys() - {"two_view_geometries"}:
        assert whole[table] == part[table]
    kept = read_inliers(few).matches
    for pair, rows in read_inliers(database).matches.items():
        assert set(map(tuple, kept[pair].tolist())) == set(map(tuple, rows[::5].tolist()))
    # The columns after the matches hold the geometry itself.
    assert [row[4:] for row in whole["two_view_geometries"]] == [
        row[4:] for row in part["two_view_geometries"]
    ]


def test_a_model_of_few_matches_gets_the_points_of_all_and_keeps_its_poses(database, few):
    every = run_mapper(database, ONE)[0]
    model = run_mapper(few, ONE)[0]
    before, points = model_poses(model), model.num_points3D()
    assert points < 0.3 * every.num_points3D()
    whole = with_all_points(model, database, ONE)
    assert whole.num_points3D() >= 0.99 * every.num_points3D()
    assert whole.compute_mean_reprojection_error() < 0.5
    after = model_poses(whole)
    assert after.keys() == before.keys()
    for name, pose in before.items():
        np.testing.assert_allclose(after[name].rotation, pose.rotation, atol=1e-12)
        np.testing.assert_allclose(after[name].centre, pose.centre, atol=1e-9)
    assert model.num_points3D() == points


def test_images_without_a_pose_stay_without_one(database, few):
    model = run_mapper(few, ONE)[0]
    gone = sorted(registered(model))[0]
    take_out(model, {gone})
    whole = with_all_points(model, database, ONE)
    assert registered(whole) == registered(model) and gone not in registered(whole)


def test_cameras_that_were_adjusted_stay_as_they_are(database, few):
    model = run_mapper(few, MapOptions(threads=1))[0]
    for camera in model.cameras.values():
        camera.params = [*(1.01 * np.asarray(camera.params[:1])), *camera.params[1:]]
    whole = with_all_points(model, database, MapOptions(threads=1))
    for camera_id, camera in model.cameras.items():
        np.testing.assert_array_equal(whole.cameras[camera_id].params, camera.params)


def test_a_file_that_is_no_database_is_named(tmp_path, few):
    model = run_mapper(few, ONE)[0]
    broken = tmp_path / "broken.db"
    broken.write_bytes(b"no database")
    with pytest.raises(UserError, match=r"broken\.db: COLMAP failed"):
        with_all_points(model, broken, ONE)


@pytest.fixture
def synthetic(tmp_path):
    """A model of five photos, and the database that its matches are in."""
    path = tmp_path / "database.db"
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 5, 60
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(path) as database:
        return pycolmap.synthesize_dataset(options, database), path


def few_points(model: pycolmap.Reconstruction, count: int) -> pycolmap.Reconstruction:
    """The model with some of its points."""
    few = pycolmap.Reconstruction(model)
    for point in sorted(few.point3D_ids())[count:]:
        few.delete_point3D(point)
    return few


def test_a_model_gets_the_points_of_all_matches_and_is_not_changed_itself(synthetic):
    model, path = synthetic
    draft = few_points(model, 20)
    whole = with_all_points(draft, path, MapOptions())
    assert whole.num_points3D() == 60 and draft.num_points3D() == 20


def test_a_model_without_any_match_keeps_its_points(synthetic):
    model, path = synthetic
    draft = few_points(model, 20)
    keep_inliers(path, {pair: rows[:0] for pair, rows in read_inliers(path).matches.items()})
    kept = with_all_points(draft, path, MapOptions())
    assert kept is not draft and kept.num_points3D() == 20


@pytest.mark.parametrize(("before", "found", "points"), [(20, 9, 20), (20, 10, 10), (5, 6, 6)])
def test_a_model_keeps_its_points_if_hardly_one_is_found(
    synthetic, monkeypatch, before, found, points
):
    model, path = synthetic
    monkeypatch.setattr(mapper, "native", lambda *_: few_points(model, found))
    kept = with_all_points(few_points(model, before), path, MapOptions())
    assert kept.num_points3D() == points
