"""The whole road on a rendered stereo rig, with matches of which some are wrong."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from room_scene import SIZE, Room, camera, hidden
from test_new_points import all_matches

from jaxsfm.bench.synthetic import arc, render, room, write_photo
from jaxsfm.colmap.cameras import Cameras, rig_intrinsics
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.poses import CameraPose, model_poses
from jaxsfm.colmap.view import View
from jaxsfm.config import Config, Refinement
from jaxsfm.io.images import inspect_image
from jaxsfm.io.photos import Pixels
from jaxsfm.io.rig_config import Rig, RigCamera
from jaxsfm.sfm.road import reconstruct

FRAMES, WRONG, NOISE_PX = 4, 0.05, 0.7
TURN = cv2.Rodrigues(np.radians([1.0, 4.0, 0.5]))[0]
RIGHT = np.asarray([0.25, 0.01, -0.02])
"""Where the right camera stands, metres in the axes of the left one."""
FREE = Config(max_size=max(SIZE), view_graph=True, checked=False, refinement=None)
WHOLE = Config(max_size=max(SIZE), view_graph=True, checked=True, refinement=Refinement())


def stereo_room() -> Room:
    rng, planes = np.random.default_rng(0), room()
    points, plane = [], []
    for k, each in enumerate(planes):
        st = rng.uniform(0.03, 0.97, (250, 2))
        points.append(each.corner + st[:, :1] * each.right + st[:, 1:] * each.down)
        plane += [k] * len(st)
    points, plane = np.concatenate(points), np.asarray(plane)
    views, poses = [], {}
    for number, left in enumerate(arc(FRAMES)):
        right = CameraPose(TURN @ left.rotation, left.centre + left.rotation.T @ RIGHT)
        for side, pose in (("l", left), ("r", right)):
            name = f"{side}/{number}.png"
            poses[name] = pose
            size, pixels = SIZE, Pixels((1.0, 1.0))
            views.append(View.without_pose(name, len(views) + 1, camera(), size, pixels).at(pose))
    visible = np.zeros((len(points), len(views)), bool)
    for k, view in enumerate(views):
        xy, depth = view.project(points)
        with np.errstate(invalid="ignore"):
            inside = (xy > 1).all(1) & (xy < np.asarray(SIZE) - 2).all(1)
        visible[:, k] = (depth > 0) & inside & ~hidden(points, plane, view.centre, planes)
    keep = visible.sum(1) >= 2
    return Room(views, {}, poses, points[keep], plane[keep], np.zeros(0), visible[keep])


@pytest.fixture(scope="module")
def scene() -> Room:
    return stereo_room()


@pytest.fixture(scope="module")
def photos(scene, tmp_path_factory):
    folder, planes = tmp_path_factory.mktemp("photos"), room()
    for name, pose in scene.poses.items():
        (folder / name).parent.mkdir(exist_ok=True)
        write_photo(folder / name, render(planes, pose, SIZE))
    return [inspect_image(folder / name, name=name) for name in sorted(scene.poses)]


def rig(*, known: bool) -> Rig:
    own = {"model": "PINHOLE", "params": tuple(camera().params)}
    place = {"rotation": TURN, "translation": -TURN @ RIGHT} if known else {}
    left = RigCamera(prefix="l/", rotation=np.eye(3), translation=np.zeros(3), **own)
    return Rig(cameras=(left, RigCamera(prefix="r/", **own, **place)), reference=0)


def noisy_matches(scene: Room):
    """Of the keypoints of each pair, some are matched in the wrong order."""
    rng, found = np.random.default_rng(1), all_matches(scene, sigma=NOISE_PX)
    for result in found.values():
        count = len(result.cells)
        wrong = rng.permutation(count)[: max(2, round(WRONG * count))]
        for column in (result.cells[:, 1], result.keypoints1):
            column[wrong] = column[np.roll(wrong, 1)]
    return found


def made(scene: Room, photos, folder: Path, *, known: bool, config: Config):
    rigs = (rig(known=known),)
    cameras = Cameras(known=rig_intrinsics(rigs, photos), rigs=rigs)
    options = MapOptions(refine_intrinsics=False, threads=1)
    matches = noisy_matches(scene)
    return reconstruct(
        photos, matches, folder / "a.db", config=config, cameras=cameras, options=options
    )


def assert_right(model, scene: Room, *, known: bool, scale: float, degrees: float) -> None:
    assert model.num_reg_images() == 2 * FRAMES
    (mount,) = (rig.non_ref_sensors for rig in model.rigs.values() if rig.num_sensors() > 1)
    (place,) = mount.values()
    turned = np.degrees(
        np.arccos(np.clip((np.trace(place.rotation.matrix() @ TURN.T) - 1) / 2, -1, 1))
    )
    assert turned < degrees
    centres = {name: pose.centre for name, pose in model_poses(model).items()}
    ours, true = (
        np.stack([of[f"l/{k}.png"] for k in range(FRAMES)])
        for of in (centres, {name: pose.centre for name, pose in scene.poses.items()})
    )
    ours, true = (np.linalg.norm(each - each.mean(0)) for each in (ours, true))
    if known:
        np.testing.assert_allclose(place.translation, -TURN @ RIGHT, atol=1e-9)
        assert abs(ours / true - 1) < scale
    else:
        base = np.linalg.norm(place.translation) * true / ours
        assert abs(base / np.linalg.norm(RIGHT) - 1) < scale
    for k in range(FRAMES):  # every frame has the same relative pose
        a, b = (model.find_image_with_name(f"{side}/{k}.png") for side in "lr")
        relative = b.cam_from_world() * a.cam_from_world().inverse()
        np.testing.assert_allclose(relative.matrix(), place.matrix(), atol=1e-9)


@pytest.mark.parametrize("known", [True, False])
def test_a_stereo_rig_is_mapped_as_one(tmp_path, scene, photos, known):
    result = made(scene, photos, tmp_path, known=known, config=FREE)
    (model,) = result.models
    assert_right(model, scene, known=known, scale=0.01, degrees=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_refinement_keeps_a_stereo_rig_rigid(tmp_path, scene, photos, known):
    result = made(scene, photos, tmp_path, known=known, config=WHOLE)
    (model,), (done,) = result.models, result.refinement
    assert done is not None and done.confirmed
    assert_right(model, scene, known=known, scale=0.005, degrees=0.05)
