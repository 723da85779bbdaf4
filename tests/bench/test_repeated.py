"""The rendered scenes that repeat themselves."""

import cv2
import numpy as np
import pytest
from room_scene import hidden

from jaxsfm.bench.inputs import read_set
from jaxsfm.bench.repeated import KINDS, PREFIX, SCENES, repeated_scene, write_repeated
from jaxsfm.bench.synthetic import TexturedPlane, camera_matrix, render
from jaxsfm.bench.walls import moved
from jaxsfm.sfm.check.common_places import POSITION_SHARE, ROTATION_DEG
from jaxsfm.sfm.view_graph import rotation_angle_deg

SIZE = (160, 120)


def moved_by_steps(scene, steps):
    """The camera in front of the first repeat, moved to another one."""
    pose = scene.facing
    for _ in range(steps):
        pose = scene.step.moved(pose)
    return pose


def picture(planes, pose):
    return render(planes, pose, SIZE).astype(int)


def project(points, pose, k):
    """Pixels (n, 2) of points in front of a camera."""
    rays = (points - pose.centre) @ pose.rotation.T @ k.T
    return rays[:, :2] / rays[:, 2:]


def corners(plane):
    ends = [plane.corner, plane.corner + plane.right]
    return np.stack([*ends, ends[1] + plane.down, plane.corner + plane.down])


@pytest.mark.parametrize("kind", KINDS)
def test_repeats_look_the_same_and_a_poster_tells_them_apart(kind):
    bare = repeated_scene(f"{PREFIX}{kind}", 3)
    views = [picture(bare.planes, moved_by_steps(bare, k)) for k in range(bare.repeats)]
    assert views[0].std() > 30  # it is a picture, and not one colour
    for view in views[1:]:
        # Rounding may take a pixel on an edge from the other side.
        assert np.mean(np.abs(view - views[0]) > 1) < 0.001
    scene = repeated_scene(f"{PREFIX}{kind}-poster", 3)
    views = [picture(scene.planes, moved_by_steps(scene, k)) for k in range(scene.repeats)]
    for k, view in enumerate(views[1:], 1):
        assert np.mean(np.abs(view - views[0]) > 10) > 0.05, k


@pytest.mark.parametrize("name", [name for name in SCENES if name.count("-") == 2])
def test_posters_change_nothing_but_the_area_they_cover(name):
    scene = repeated_scene(name, 1)
    bare = repeated_scene(name.rpartition("-")[0], 1)
    posters = scene.planes[len(bare.planes) :]
    assert len(posters) == (1 if name.endswith("-poster") else scene.repeats - 1)
    k, changed = camera_matrix(SIZE), 0
    for pose, same in zip(scene.poses, bare.poses, strict=True):
        np.testing.assert_array_equal(pose.centre, same.centre)
        covered = np.zeros(SIZE[::-1], np.uint8)
        for poster in posters:
            if ((corners(poster) - pose.centre) @ pose.rotation[2] > 0.1).all():
                cv2.fillConvexPoly(
                    covered, project(corners(poster), pose, k).round().astype(int), 1
                )
        covered = cv2.dilate(covered, np.ones((5, 5), np.uint8)) > 0
        differs = (picture(scene.planes, pose) != picture(bare.planes, pose)).any(axis=-1)
        assert not (differs & ~covered).any()
        changed += differs.sum()
    assert changed > 0.01 * SIZE[0] * SIZE[1] * len(scene.poses) / scene.repeats


@pytest.mark.parametrize("kind", KINDS)
def test_the_written_cameras_show_points_where_they_were_rendered(kind, tmp_path):
    name = f"{PREFIX}{kind}-poster"
    write_repeated(tmp_path / "scene", name, 2, SIZE)
    written, scene = read_set(tmp_path / "scene"), repeated_scene(name, 2)
    fx, fy, cx, cy = map(float, written.camera.removeprefix("PINHOLE:").split(","))
    # COLMAP's pixels are half a pixel larger than the renderer's.
    k = np.asarray([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    # All planes black, but for a white spot in the middle of the poster.
    spot = np.zeros((201, 201, 3), np.uint8)
    spot[92:109, 92:109] = 255
    black = [_painted(plane, np.zeros((2, 2, 3), np.uint8)) for plane in scene.planes[:-1]]
    poster = scene.planes[-1]
    middle = (poster.corner + 0.5 * poster.right + 0.5 * poster.down)[None]
    seen = 0
    for photo, pose in sorted(written.truth.items()):
        image = render([*black, _painted(poster, spot)], pose, SIZE)[..., 0].astype(float)
        if image.sum() < 255 * 4 or image[[0, -1]].any() or image[:, [0, -1]].any():
            continue
        y, x = np.indices(image.shape)
        centroid = np.asarray([(x * image).sum(), (y * image).sum()]) / image.sum()
        # The centroid of a small square is its centre's image, to its size over its distance.
        np.testing.assert_allclose(centroid, project(middle, pose, k)[0], atol=0.15, err_msg=photo)
        seen += 1
    assert seen >= 2
    stored = cv2.imread(str(tmp_path / "scene" / "images" / photo))[..., ::-1]
    np.testing.assert_array_equal(stored, render(scene.planes, scene.poses[-1], SIZE))


def _painted(plane, texture):
    return TexturedPlane(corner=plane.corner, right=plane.right, down=plane.down, texture=texture)


def test_one_poster_tells_every_photo_of_a_room():
    """Each shows an end wall, or the place of the poster on its wall or on the opposite one."""
    for seed in range(6):
        scene = repeated_scene("synthetic-room-poster", seed)
        white, black = (np.full((2, 2, 3), value, np.uint8) for value in (255, 0))
        poster = scene.planes[-1]
        planes = [_painted(plane, black) for plane in scene.planes[:2]]
        planes += [_painted(plane, white) for plane in [*scene.planes[2:4], poster]]
        planes.append(_painted(moved(poster, scene.step), white))
        for pose in scene.poses:
            assert np.mean(picture(planes, pose) > 100) > 0.04


@pytest.mark.parametrize("kind", KINDS)
def test_every_photo_shows_much_of_what_the_next_one_shows(kind):
    """So a right model of all photos exists."""
    for seed in range(3):
        scene = repeated_scene(f"{PREFIX}{kind}", seed)
        rng = np.random.default_rng(0)
        points, own = [], []
        for k, plane in enumerate(scene.planes):
            area = np.linalg.norm(np.cross(plane.right, plane.down))
            st = rng.uniform(0, 1, (round(30 * area), 2))
            points.append(plane.corner + st[:, :1] * plane.right + st[:, 1:] * plane.down)
            own += [k] * len(st)
        points, own = np.concatenate(points), np.asarray(own)
        visible = [_visible(points, own, pose, scene.planes) for pose in scene.poses]
        for now, following in zip(visible, visible[1:], strict=False):
            assert (now & following).sum() > 0.4 * min(now.sum(), following.sum()) > 40


def _visible(points, own, pose, planes):
    k = camera_matrix(SIZE)
    ahead = (points - pose.centre) @ pose.rotation[2] > 0.1
    pixel = project(points, pose, k)
    inside = ((pixel > 0) & (pixel < np.asarray(SIZE) - 1)).all(axis=1)
    return ahead & inside & ~hidden(points, own, pose.centre, planes)


def test_steps_between_repeats_are_more_than_twice_the_limits_of_a_right_photo():
    """Otherwise photos of two repeats could be one group."""
    for kind in KINDS:
        for seed in range(2):
            scene = repeated_scene(f"{PREFIX}{kind}", seed)
            centres = np.asarray([pose.centre for pose in scene.poses])
            width = np.linalg.norm(centres[:, None] - centres[None], axis=-1).max()
            angle = rotation_angle_deg(scene.step.rotation, np.eye(3))
            shift = np.linalg.norm(scene.step.translation)
            assert angle > 2 * ROTATION_DEG or shift > 2 * POSITION_SHARE * width


def test_a_scene_is_drawn_from_its_seed(tmp_path):
    name = "synthetic-tower"
    first, again, other = (repeated_scene(name, seed) for seed in (5, 5, 6))
    view = picture(first.planes, first.poses[0])
    np.testing.assert_array_equal(view, picture(again.planes, again.poses[0]))
    assert (picture(other.planes, other.poses[0]) != view).mean() > 0.5
    with pytest.raises(ValueError, match="synthetic-room, .*'tower'"):
        repeated_scene("tower", 0)
