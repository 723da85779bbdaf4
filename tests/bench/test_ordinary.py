"""The rendered ordinary scenes."""

from collections import Counter

import cv2
import numpy as np
import pytest
from room_scene import hidden

from jaxsfm.bench import ordinary_parts
from jaxsfm.bench.inputs import read_set
from jaxsfm.bench.ordinary import KINDS, PREFIX, SCENES, ordinary_scene, write_ordinary
from jaxsfm.bench.ordinary_parts import SHADE, Look, developed, ordinary_photo, planes_in
from jaxsfm.bench.synthetic import TexturedPlane, camera_matrix, render

SIZE = (160, 120)


@pytest.fixture
def blank(monkeypatch):
    """Scenes have the same geometry as always, and black surfaces, which are quickly drawn."""

    def black(seed, size):
        return np.zeros((*size[::-1], 3), np.uint8)

    monkeypatch.setattr(ordinary_parts, "collage", black)


def painted(plane, value):
    texture = np.full((2, 2, 3), value, np.uint8)
    return TexturedPlane(corner=plane.corner, right=plane.right, down=plane.down, texture=texture)


def seen(scene, view):
    """The points (n, 3) of a regular grid of pixels, and the index of the plane of each.

    The sky has none.
    """
    pose, planes = scene.poses[view], [*scene.planes, *scene.passers[view : view + 1]]
    x, y = np.meshgrid(np.arange(2, SIZE[0], 5), np.arange(2, SIZE[1], 5))
    pixels = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    rays = pixels @ np.linalg.inv(camera_matrix(SIZE)).T @ pose.rotation
    nearest, own = np.full(len(rays), np.inf), np.zeros(len(rays), int)
    for k, plane in enumerate(planes):
        # corner + s * right + t * down = centre + depth * ray
        sides = np.stack(np.broadcast_arrays(plane.right, plane.down, -rays), axis=-1)
        s, t, depth = np.linalg.solve(sides, (pose.centre - plane.corner)[:, None])[..., 0].T
        hit = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1) & (depth > 0) & (depth < nearest)
        nearest[hit], own[hit] = depth[hit], k
    found = np.isfinite(nearest)
    return pose.centre + nearest[found, None] * rays[found], own[found]


def shown(points, own, scene, view):
    """Whether a photo shows each point, which lies on the plane with the index `own`."""
    pose = scene.poses[view]
    rays = (points - pose.centre) @ pose.rotation.T @ camera_matrix(SIZE).T
    inside = (rays[:, :2] >= 0).all(axis=1)
    inside &= (rays[:, :2] <= (np.asarray(SIZE) - 1) * rays[:, 2:]).all(axis=1)
    return inside & (rays[:, 2] > 0) & ~hidden(points, own, pose.centre, scene.planes)


@pytest.mark.parametrize("name", SCENES)
def test_most_of_what_a_photo_shows_is_shown_by_its_neighbours_too(name, blank):
    """So a right model of all photos exists."""
    for seed in range(4):
        scene = ordinary_scene(name, seed)._replace(passers=[])
        assert 6 <= len(scene.poses) <= 10
        for view in range(len(scene.poses)):
            points, own = seen(scene, view)
            assert len(points) > 0.4 * (SIZE[0] / 5) * (SIZE[1] / 5)  # the rest is sky
            for other in {view - 1, view + 1} & set(range(len(scene.poses))):
                assert shown(points, own, scene, other).mean() > 0.6, (seed, view, other)


@pytest.mark.parametrize("name", SCENES)
def test_parts_repeat_but_most_of_each_photo_occurs_only_once(name, blank, monkeypatch):
    element = ordinary_parts.Brush.element

    def white(*given):
        return np.full_like(element(*given), 255)

    def as_it_is(brush, canvas, contrast):
        brush.rng.random(4)  # as many as `faded` draws
        return canvas.copy()

    monkeypatch.setattr(ordinary_parts.Brush, "element", white)
    monkeypatch.setattr(ordinary_parts.Brush, "faded", as_it_is)
    scene = ordinary_scene(name, 1)
    uses = Counter(id(plane.texture) for plane in scene.planes)
    planes = [painted(p, 255) if uses[id(p.texture)] > 1 else p for p in scene.planes]
    planes += [painted(p, 0) for p in scene.sky]
    shares = [np.mean(render(planes, pose, SIZE) > 200) for pose in scene.poses]
    assert 0.01 < max(shares) < 0.5


@pytest.mark.parametrize("name", SCENES)
def test_every_pixel_shows_something(name, blank):
    """Where nothing is, a rendered image is black."""
    scene = ordinary_scene(name, 2)
    planes = [painted(plane, 255) for plane in [*scene.planes, *scene.sky]]
    for pose in scene.poses:
        assert (render(planes, pose, SIZE) > 250).mean() > 0.999


@pytest.mark.slow
def test_somebody_who_passes_by_covers_a_part_of_each_photo(blank):
    scenes = [ordinary_scene(name, seed) for name in SCENES for seed in range(5)]
    crowded = [scene for scene in scenes if scene.passers]
    assert 0.2 < len(crowded) / len(scenes) < 0.5
    for scene in crowded:
        centres = np.asarray([p.corner + (p.right + p.down) / 2 for p in scene.passers])
        assert np.linalg.norm(np.diff(centres, axis=0), axis=1).min() > 0.02
        for view in range(len(scene.poses)):
            _, own = seen(scene, view)
            assert 0.01 < np.mean(own == len(scene.planes)) < 0.3
            planes = planes_in(scene._replace(shadows=[]), view)
            assert sum(plane is scene.passers[view] for plane in planes) == 1


def test_a_shadow_darkens_a_part_of_some_photos_and_moves():
    scene = next(s for s in (ordinary_scene("ordinary-facade", k) for k in range(20)) if s.shadows)
    bare = scene._replace(shadows=[], sky=[], passers=[])
    parts = []
    for view, pose in enumerate(scene.poses[:3]):
        lit = render(planes_in(bare, view), pose, SIZE).astype(float)
        dim = render(planes_in(scene._replace(sky=[], passers=[]), view), pose, SIZE)
        assert (dim <= lit + 1).all() and (dim >= SHADE * lit - 2).all()
        parts.append((dim < 0.8 * lit)[lit > 30].mean())
    assert 0.02 < max(parts) < 0.98
    assert len({offset for _, offset in scene.shadows}) == len(scene.poses)


def test_a_look_changes_brightness_contrast_and_sharpness_as_it_says():
    image = np.full((30, 40, 3), 100, np.uint8)
    image[:, 20:] = 150
    plain = Look(gain=1.0, contrast=1.0, slope=np.zeros(2), blur=0.0, noise=0.0, seed=1)
    np.testing.assert_array_equal(developed(image, plain), image)
    np.testing.assert_array_equal(developed(image, plain._replace(gain=0.8)), 0.8 * image)
    flatter = developed(image, plain._replace(contrast=0.5))
    np.testing.assert_array_equal(np.unique(flatter), [114, 139])
    sloped = developed(image, plain._replace(slope=np.asarray([0.2, 0.0])))
    np.testing.assert_array_equal(sloped[0, [0, -1], 0], [90, 165])
    noisy = developed(image, plain._replace(noise=3.0)).astype(float) - image
    assert 2.8 < noisy.std() < 3.2
    soft = developed(image, plain._replace(blur=10.0))
    assert 100 < soft[15, 19, 0] < 128 and soft[15, 0, 0] == 100


@pytest.mark.parametrize("kind", ["fence", "corner"])
def test_the_written_cameras_and_photos_are_those_of_the_scene(kind, tmp_path):
    name = f"{PREFIX}{kind}"
    write_ordinary(tmp_path / "scene", name, 2, SIZE)
    written, scene = read_set(tmp_path / "scene"), ordinary_scene(name, 2)
    k = camera_matrix(SIZE)
    # COLMAP's pixels are half a pixel larger than the renderer's.
    expected = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5]
    given = written.camera.removeprefix("PINHOLE:").split(",")
    np.testing.assert_allclose([float(v) for v in given], expected, atol=1e-6)
    assert sorted(written.truth) == [f"view{i:02d}.png" for i in range(len(scene.poses))]
    for i, pose in enumerate(scene.poses):
        truth = written.truth[f"view{i:02d}.png"]
        np.testing.assert_allclose(truth.rotation, pose.rotation, atol=1e-8)
        np.testing.assert_allclose(truth.centre, pose.centre, atol=1e-7)
    stored = cv2.imread(str(tmp_path / "scene" / "images" / "view01.png"))[..., ::-1]
    np.testing.assert_array_equal(stored, ordinary_photo(scene, 1, SIZE))
    (tmp_path / "scene" / "images" / "view01.png").unlink()
    write_ordinary(tmp_path / "scene", name, 2, SIZE)
    assert not (tmp_path / "scene" / "images" / "view01.png").exists()


def test_a_scene_is_drawn_from_its_seed():
    name = "ordinary-corner"
    first, again, other = (ordinary_scene(name, seed) for seed in (5, 5, 6))
    photo = ordinary_photo(first, 0, SIZE).astype(int)
    assert photo.std() > 15
    np.testing.assert_array_equal(photo, ordinary_photo(again, 0, SIZE))
    assert (np.abs(ordinary_photo(other, 0, SIZE) - photo) > 5).mean() > 0.5
    with pytest.raises(ValueError, match="ordinary-facade, .*'corner'"):
        ordinary_scene("corner", 0)
    assert len(KINDS) == len(SCENES) == 8
