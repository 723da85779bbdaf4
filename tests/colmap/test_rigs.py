"""Rigs in COLMAP's databases, and what follows from them for cameras and pairs."""

import cv2
import numpy as np
import pycolmap
import pytest

from jaxsfm.colmap.cameras import Cameras, rig_intrinsics
from jaxsfm.colmap.database import read_images, write_database
from jaxsfm.colmap.rigs import (
    have_common_centre,
    one_of_each_frame,
    pairs_against_rigs,
    rigs_of_database,
    whole_frames,
)
from jaxsfm.colmap.two_views import PairGeometry, TwoView
from jaxsfm.errors import UserError
from jaxsfm.io.images import inspect_image
from jaxsfm.io.rig_config import Rig, RigCamera

SIZE = (64, 48)
PARAMS = (60.0, 60.0, 32.0, 24.0)
NAMES = ["a.png", "l/0.png", "l/1.png", "m/0.png", "r/0.png", "r/1.png"]
QUARTER = cv2.Rodrigues(np.asarray([0, np.pi / 2, 0]))[0]


def rig(*, base=(0.2, 0.0, 0.0), params=PARAMS, model="PINHOLE"):
    """l/ is the reference, m/ stands where nobody knows, and r/ is turned by 90 degrees."""
    known = {"model": model, "params": params}
    cameras = (
        RigCamera(prefix="m/"),
        RigCamera(prefix="l/", rotation=np.eye(3), translation=np.zeros(3), **known),
        RigCamera(prefix="r/", rotation=QUARTER, translation=np.asarray(base), **known),
    )
    return Rig(cameras=cameras, reference=1)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for name in NAMES:
        (folder / name).parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(folder / name), np.zeros((*SIZE[::-1], 3), np.uint8))
    return [inspect_image(folder / name, name=name) for name in NAMES]


def test_a_database_has_the_rig_its_frames_and_a_camera_for_each_prefix(tmp_path, photos):
    cameras = Cameras(rigs=(rig(),))
    cameras.check_fits(photos)
    write_database(tmp_path / "a.db", photos, {}, cameras)
    images = read_images(tmp_path / "a.db")
    ids = {name: images[name][0] for name in NAMES}
    used = {name: images[name][1].camera_id for name in NAMES}
    # l/ and r/ have the same intrinsics, and a camera each.
    assert len(set(used.values())) == 4 and used["l/0.png"] == used["l/1.png"]
    assert list(images["r/1.png"][1].params) == list(PARAMS)
    assert cameras.held(photos) == (used["r/0.png"],)
    rigs = rigs_of_database(tmp_path / "a.db")
    assert list(rigs.rigs) == [used["l/0.png"]]
    assert rigs.frames == {
        ids[name]: (ids[first], used["l/0.png"])
        for first, frame in (
            ("l/0.png", ["l/0.png", "m/0.png", "r/0.png"]),
            ("l/1.png", ["l/1.png", "r/1.png"]),
        )
        for name in frame
    }
    pose = rigs.cam_from_rig(used["r/0.png"], used["l/0.png"])
    np.testing.assert_allclose(pose.rotation.matrix(), QUARTER, atol=1e-12)
    assert rigs.cam_from_rig(used["m/0.png"], used["l/0.png"]) is None
    assert not rigs.is_placed(ids["l/0.png"]) and rigs.is_placed(ids["a.png"])
    with pycolmap.Database.open(tmp_path / "a.db") as db:
        assert db.num_frames() == 3 and db.num_rigs() == 2  # the photo that is alone has its own


def test_a_database_without_rigs_has_no_frames(tmp_path, photos):
    write_database(tmp_path / "a.db", photos, {}, Cameras())
    with pycolmap.Database.open(tmp_path / "a.db") as db:
        assert db.num_frames() == db.num_rigs() == 0
    assert rigs_of_database(tmp_path / "a.db") is None
    assert Cameras().held(photos) == ()
    assert Cameras().plain() == ["auto", "SIMPLE_RADIAL"]  # stages of runs without rigs hold


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"model": "BALL"}, "camera_model_name must be one of"),
        ({"params": (60.0, 32.0, 24.0)}, r"must be 4 numbers \(fx, fy, cx, cy\); got 3"),
        ({"params": (600.0, 600.0, 320.0, 240.0)}, "not those of photos of 64 x 48 pixels"),
        ({"params": (-60.0, -60.0, 32.0, 24.0)}, "not those of photos of 64 x 48 pixels"),
    ],
)
def test_intrinsics_of_a_rig_must_be_those_of_its_photos(photos, change, sentence):
    assert rig_intrinsics([rig()], photos).keys() == {n for n in NAMES if n[0] in "lr"}
    with pytest.raises(UserError, match=f"--rig: the camera ./: .*{sentence}"):
        rig_intrinsics([rig(**change)], photos)


def two_view(rotation):
    return TwoView(PairGeometry(num_inliers=100, rotation=rotation), 5.0, False)


def test_pairs_that_contradict_their_rig_are_found(tmp_path, photos):
    right, wrong = ("l/0.png", "r/0.png"), ("l/1.png", "r/1.png")
    other = {("l/0.png", "m/0.png"): two_view(np.eye(3)), ("l/0.png", "r/1.png"): two_view(None)}
    views = {right: two_view(QUARTER), wrong: two_view(np.eye(3))} | other
    write_database(tmp_path / "a.db", photos, {}, Cameras(rigs=(rig(),)))
    assert pairs_against_rigs(tmp_path / "a.db", views, 15.0) == [wrong]
    write_database(tmp_path / "b.db", photos, {}, Cameras(rigs=(rig(base=(0, 0, 0)),)))
    assert pairs_against_rigs(tmp_path / "b.db", views, 15.0) == [right, wrong]
    assert not have_common_centre(rigs_of_database(tmp_path / "b.db"))  # nobody knows of m/


def test_parts_of_one_frame_are_one_part():
    options = pycolmap.SyntheticDatasetOptions(num_cameras_per_rig=2, num_frames_per_rig=2)
    options.num_rigs, options.num_points3D = 1, 20
    model = pycolmap.synthesize_dataset(options)
    first, second = (
        sorted(model.image(data.id).name for data in frame.image_ids)
        for _, frame in sorted(model.frames.items())
    )
    apart = [[first[0], second[0]], [first[1]], [second[1]]]
    assert [sorted(part) for part in whole_frames(apart, model)] == [sorted(first + second)]
    assert whole_frames([first, second], model) == [first, second]
    assert one_of_each_frame(sorted(first + second), model) == [first[0], second[0]]
    options.num_cameras_per_rig = 1
    alone = pycolmap.synthesize_dataset(options)
    names = [image.name for image in alone.images.values()]
    assert one_of_each_frame(names, alone) == names
    names = [[image.name] for image in alone.images.values()]
    assert whole_frames(names, alone) == names
