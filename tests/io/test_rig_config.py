"""COLMAP's rig_config.json: what is read, what is refused, and which photos are a frame."""

import json

import numpy as np
import pycolmap
import pytest

from jaxsfm.errors import UserError
from jaxsfm.io.rig_config import (
    Rig,
    RigCamera,
    check_rigs,
    frames_of,
    incomplete_frames,
    read_rigs,
    rig_photos,
)

HALF = float(np.sqrt(0.5))
REFERENCE = {"image_prefix": "left/", "ref_sensor": True}
RIGHT = {
    "image_prefix": "right/",
    "cam_from_rig_rotation": [HALF, 0, HALF, 0],
    "cam_from_rig_translation": [-0.2, 0.0, 0.1],
    "camera_model_name": "PINHOLE",
    "camera_params": [500, 500, 320, 240],
}


def written(folder, *rigs):
    path = folder / "rig_config.json"
    path.write_text(json.dumps([{"cameras": list(cameras)} for cameras in rigs]))
    return path


def test_rigs_are_read_as_colmap_reads_them(tmp_path):
    path = written(tmp_path, [REFERENCE, RIGHT], [{"image_prefix": "up/", "ref_sensor": True}])
    rigs, theirs = read_rigs(path), pycolmap.read_rig_config(path)
    assert [rig.reference for rig in rigs] == [0, 0]
    for rig, other in zip(rigs, theirs, strict=True):
        for camera, colmaps in zip(rig.cameras, other.cameras, strict=True):
            assert camera.prefix == colmaps.image_prefix
            if colmaps.cam_from_rig is not None:
                assert np.allclose(camera.rotation, colmaps.cam_from_rig.rotation.matrix())
                assert np.allclose(camera.translation, colmaps.cam_from_rig.translation)
    right = rigs[0].cameras[1]
    assert right.model == "PINHOLE" and right.params == (500, 500, 320, 240)
    # A quarter turn about y takes the rig's x axis to the camera's -z axis.
    assert np.allclose(right.rotation @ [1, 0, 0], [0, 0, -1])


def test_a_camera_without_a_pose_is_estimated(tmp_path):
    (rig,) = read_rigs(written(tmp_path, [REFERENCE, {"image_prefix": "right/"}]))
    assert rig.cameras[0].known and not rig.cameras[1].known
    assert np.array_equal(rig.cameras[0].rotation, np.eye(3))


NO_ROTATION = {k: v for k, v in RIGHT.items() if k != "cam_from_rig_rotation"}
REFUSED = {
    "no reference": ([RIGHT], "one camera must be the reference"),
    "two references": ([REFERENCE, {"image_prefix": "b/", "ref_sensor": True}], "2 are"),
    "a reference with a pose": ([RIGHT | {"ref_sensor": True}], "the reference has no"),
    "a long quaternion": (
        [REFERENCE, RIGHT | {"cam_from_rig_rotation": [1, 1, 0, 0]}],
        "quaternion w, x, y, z of length 1; its length is 1.41",
    ),
    "three numbers": (
        [REFERENCE, RIGHT | {"cam_from_rig_rotation": [1, 0, 0]}],
        "is not a rig_config.json",
    ),
    "half a pose": ([REFERENCE, NO_ROTATION], "must be given together"),
    "a number that is not finite": (
        [REFERENCE, RIGHT | {"cam_from_rig_translation": [0, 0, float("nan")]}],
        "the numbers must be finite",
    ),
    "one prefix twice": ([REFERENCE, RIGHT | {"image_prefix": "left/"}], "prefix of two cameras"),
    "a prefix of a prefix": (
        [REFERENCE, RIGHT | {"image_prefix": "left/b/"}],
        "begins with that of another camera",
    ),
    "a word for a prefix": ([REFERENCE, {"prefix": "right/"}], "is not a rig_config.json"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_rig_that_cannot_be_is_refused_in_one_sentence(tmp_path, case):
    cameras, sentence = REFUSED[case]
    with pytest.raises(UserError, match=sentence) as caught:
        read_rigs(written(tmp_path, cameras))
    assert "\n" not in str(caught.value) and "--rig" in str(caught.value)


def test_two_rigs_cannot_share_a_camera(tmp_path):
    with pytest.raises(UserError, match="left/ is the prefix of two cameras"):
        read_rigs(written(tmp_path, [REFERENCE, RIGHT], [REFERENCE]))


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", "{}", "[" * 100_000])
def test_what_is_no_rig_config_is_refused(tmp_path, content):
    path = tmp_path / "rig.json"
    path.write_text(content)
    with pytest.raises(UserError, match="--rig"):
        read_rigs(path)
    with pytest.raises(UserError, match="cannot be read"):
        read_rigs(tmp_path)


def stereo():
    return Rig(
        cameras=(
            RigCamera(prefix="left/", rotation=np.eye(3), translation=np.zeros(3)),
            RigCamera(prefix="right/"),
        ),
        reference=0,
    )


def test_photos_with_the_same_name_after_the_prefix_are_a_frame():
    names = ["right/1.jpg", "left/1.jpg", "left/2.jpg", "alone.jpg"]
    photos = rig_photos([stereo()], names)
    assert "alone.jpg" not in photos
    assert frames_of(photos) == {
        (0, "1.jpg"): ["left/1.jpg", "right/1.jpg"],
        (0, "2.jpg"): ["left/2.jpg"],
    }
    assert incomplete_frames([stereo()], names) == ["left/2.jpg"]
    assert incomplete_frames([], names) == []


def test_each_camera_of_a_rig_needs_photos_of_one_size():
    sizes = {"left/1.jpg": (640, 480), "left/2.jpg": (640, 480), "right/1.jpg": (320, 240)}
    check_rigs([stereo()], sizes)
    with pytest.raises(UserError, match="no photo has a name that begins with right/"):
        check_rigs([stereo()], {"left/1.jpg": (640, 480)})
    with pytest.raises(UserError, match="left/ differ in size.* left/2.jpg has 480 x 640"):
        check_rigs([stereo()], sizes | {"left/2.jpg": (480, 640)})


def test_the_reference_has_the_pose_of_the_rig():
    camera = RigCamera(prefix="a/", rotation=np.eye(3), translation=np.ones(3))
    with pytest.raises(ValueError, match="reference must have the pose of the rig"):
        Rig(cameras=(camera,), reference=0)
    with pytest.raises(ValueError, match="given together"):
        Rig(cameras=(*stereo().cameras, RigCamera(prefix="b", rotation=np.eye(3))), reference=0)
    with pytest.raises(ValueError, match="reference must be one of"):
        Rig(cameras=(), reference=0)


def test_rigs_that_differ_have_different_plain_forms():
    moved = Rig(
        cameras=(
            stereo().cameras[0],
            RigCamera(prefix="right/", rotation=np.eye(3), translation=np.ones(3)),
        ),
        reference=0,
    )
    assert json.dumps(stereo().plain()) != json.dumps(moved.plain())
