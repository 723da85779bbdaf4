"""An exact scene through the adapter to COLMAP: database, verification, mapping."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from mapped import map_database

from jaxsfm.colmap import database as colmap
from jaxsfm.colmap import mapper as mapping
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import (
    keypoint_tables,
    write_database,
)
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_files import write_models
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.two_views import read_two_views
from jaxsfm.io.images import ImageFile
from jaxsfm.sfm.evaluation import evaluate

ONE = MapOptions(refine_intrinsics=False, threads=1)


def errors(model, truth) -> tuple[int, float, float]:
    result = evaluate(model_poses(model), model_poses(truth))
    return len(result.images), result.position["max"], result.rotation_deg["max"]


# -- the way through -------------------------------------------------------------------------------


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_an_exact_scene_comes_back_with_its_odd_names(tmp_path, scene, mapper):
    write_database(tmp_path / "d.db", scene.images, scene.results, scene.cameras)
    models = map_database(tmp_path / "d.db", dataclasses.replace(ONE, mapper=mapper))
    registered, position, rotation = errors(models[0], scene.truth)
    assert registered == len(scene.names) and position < 1e-4 and rotation < 1e-3
    (camera,) = models[0].cameras.values()
    assert tuple(camera.params) == scene.cameras.known.params  # to the bit
    assert read_two_views(tmp_path / "d.db").keys() == scene.results.keys()


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_a_wrong_focal_length_moves_only_when_refined(tmp_path, scene, mapper):
    wrong = Intrinsics(model="SIMPLE_PINHOLE", params=(1250.0, 512.0, 384.0))
    write_database(tmp_path / "d.db", scene.images, scene.results, Cameras(known=wrong))
    for refine in (False, True):
        options = dataclasses.replace(ONE, mapper=mapper, refine_intrinsics=refine)
        model = map_database(tmp_path / "d.db", options)[0]
        (camera,) = model.cameras.values()
        if refine:
            assert camera.params[0] == pytest.approx(1280, abs=0.5)
            assert tuple(camera.params[1:]) == wrong.params[1:]
        else:
            assert tuple(camera.params) == wrong.params


def test_without_intrinsics_every_image_has_its_camera(tmp_path, scene):
    write_database(tmp_path / "d.db", scene.images, scene.results, Cameras(sharing="photo"))
    with pycolmap.Database.open(tmp_path / "d.db") as db:
        cameras = db.read_all_cameras()
        assert len({image.camera_id for image in db.read_all_images()}) == len(scene.names)
    assert len(cameras) == len(scene.names)
    for camera in cameras:  # the files do not exist: the guess is COLMAP's
        assert not camera.has_prior_focal_length
        assert (camera.model_name, list(camera.params)) == ("SIMPLE_RADIAL", [1228.8, 512, 384, 0])
    models = map_database(tmp_path / "d.db", MapOptions(threads=1))
    registered, _, rotation = errors(models[0], scene.truth)
    assert registered == len(scene.names) and rotation < 1.0


def test_the_database_holds_the_matches_half_a_pixel_further(tmp_path, scene):
    write_database(tmp_path / "d.db", scene.images, scene.results, scene.cameras)
    with pycolmap.Database.open(tmp_path / "d.db") as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        assert sorted(ids) == scene.names
        (camera,) = db.read_all_cameras()
        assert (
            camera.has_prior_focal_length and (camera.width, camera.height) == scene.images[0].size
        )
        for (a, b), result in scene.results.items():
            rows = db.read_matches(ids[a], ids[b])
            for side, name in enumerate((a, b)):
                xy = db.read_keypoints(ids[name])[rows[:, side], :2]
                want = (result.keypoints0, result.keypoints1)[side] + np.float32(0.5)
                assert xy.dtype == np.float32 and np.array_equal(xy, want)


def shuffled(results):
    """Half of every pair's matches, in any order."""
    rng = np.random.default_rng(0)
    for pair, result in results.items():
        rows = rng.permutation(result.num_inliers)[: result.num_inliers // 2]
        fields = ("cells", "keypoints0", "keypoints1", "plane")
        yield pair, dataclasses.replace(result, **{f: getattr(result, f)[rows] for f in fields})


def test_a_cell_is_one_keypoint_in_all_pairs(scene):
    few = dict(list(shuffled(scene.results))[:4])
    tables = keypoint_tables(few.values())
    for result in few.values():
        for side, name in enumerate(result.pair):
            cells, xy = tables[name]
            assert (np.diff(cells) > 0).all() and len(cells) == len(xy)
            row = {cell: tuple(p) for cell, p in zip(cells, xy, strict=True)}
            for cell, p in zip(
                result.cells[:, side], (result.keypoints0, result.keypoints1)[side], strict=True
            ):
                assert row[cell] == tuple(p)


def test_keypoints_are_the_same_however_many_pairs_are_held_apart(scene, monkeypatch):
    results = dict(shuffled(scene.results))
    tables = keypoint_tables(results.values())
    for held in (0, 1, 2, 1000):
        monkeypatch.setattr(colmap, "UNITED", held)
        again = keypoint_tables(results.values())
        assert again.keys() == tables.keys()
        for name, (cells, xy) in tables.items():
            np.testing.assert_array_equal(again[name][0], cells)
            np.testing.assert_array_equal(again[name][1], xy)


def test_seed_threads_and_scale_reach_all_of_colmaps_options():
    """A scene without outliers comes back the same whatever they are."""
    options = MapOptions(seed=7, threads=1, scale=2.0)
    plain = pycolmap.IncrementalPipelineOptions().mapper
    for got in (mapping.incremental_options(options), mapping.global_options(options)):
        assert (got.random_seed, got.mapper.random_seed) == (7, 7)
        assert (got.num_threads, got.mapper.num_threads) == (1, 1)
    mapper = mapping.incremental_options(options).mapper
    for name in ("init_max_error", "abs_pose_max_error", "filter_max_reproj_error"):
        assert getattr(mapper, name) == 2 * getattr(plain, name)


def test_one_thread_and_one_seed_give_the_same_bytes(tmp_path, scene):
    files = []
    for run in ("1", "2"):
        database, out = tmp_path / f"{run}.db", tmp_path / run
        write_database(database, scene.images, dict(reversed(scene.results.items())), Cameras())
        write_models(map_database(database, MapOptions(threads=1, seed=7)), out)
        files.append({p.relative_to(out): p.read_bytes() for p in out.rglob("*") if p.is_file()})
    assert files[0] and files[0] == files[1]


def test_an_image_without_matches_is_in_the_database_but_not_in_the_model(tmp_path, scene):
    lonely = ImageFile(
        name="0.png", path=tmp_path / "0.png", size=scene.images[0].size, sha256=64 * "0"
    )
    write_database(tmp_path / "d.db", [lonely, *scene.images], scene.results, scene.cameras)
    model = map_database(tmp_path / "d.db", ONE)[0]
    assert sorted(model_poses(model)) == scene.names
    with pycolmap.Database.open(tmp_path / "d.db") as db:
        assert len(db.read_all_images()) == len(scene.names) + 1


def test_no_matches_give_no_model(tmp_path, scene):
    for mapper in ("incremental", "global"):
        write_database(tmp_path / "d.db", scene.images, {}, scene.cameras)  # replaces the former
        assert map_database(tmp_path / "d.db", dataclasses.replace(ONE, mapper=mapper)) == []
    assert read_two_views(tmp_path / "d.db") == {}
