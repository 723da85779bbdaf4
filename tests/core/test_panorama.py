"""Laws of the geometry of panoramas and of their pinhole views."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsfm.core.panorama import (
    Direction,
    ViewSet,
    panorama_directions,
    panorama_pixels,
    rows_per_pixel,
)

SIZE = (64, 32)
AROUND = ViewSet((Direction(0, 0), Direction(90, 0), Direction(-120, 35), Direction(10, -80)), 80.0)


def slow_pixel(direction, size):
    """Where a panorama shows a direction, by the angles of a globe's map, one number at a time."""
    x, y, z = np.asarray(direction) / np.linalg.norm(direction)
    latitude = np.degrees(np.arcsin(-y))
    longitude = np.degrees(np.angle(complex(z, x)))
    return [(longitude + 180) / 360 * size[0] - 0.5, (90 - latitude) / 180 * size[1] - 0.5]


def slow_view_ray(direction: Direction, fov: float, side: int, x: float, y: float):
    """The direction in the panorama of a pixel of a view: the camera is tilted, then turned."""
    focal = side / 2 / np.tan(np.radians(fov / 2))
    ray = [(x + 0.5 - side / 2) / focal, (y + 0.5 - side / 2) / focal, 1.0]
    tilted = Rotation.from_euler("x", direction.pitch, degrees=True).apply(ray)
    return Rotation.from_euler("y", direction.heading, degrees=True).apply(tilted)


def test_directions_are_shown_where_a_map_of_the_globe_has_them():
    drawn = np.random.default_rng(0).normal(size=(50, 3))
    found = panorama_pixels(drawn, SIZE)
    np.testing.assert_allclose(found, [slow_pixel(each, SIZE) for each in drawn], atol=1e-9)


def test_known_directions():
    axes = np.asarray([[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 1e-12], [0, -1, 1e-12]])
    wanted = [[31.5, 15.5], [47.5, 15.5], [15.5, 15.5], [31.5, 31.5], [31.5, -0.5]]
    np.testing.assert_allclose(panorama_pixels(axes, SIZE), wanted, atol=1e-9)


def test_pixels_and_directions_are_inverse():
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    xy = np.stack([x, y], axis=-1).astype(float)
    directions = panorama_directions(xy, SIZE)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(panorama_pixels(directions, SIZE), xy, atol=1e-9)


def test_pixels_of_views_look_where_a_tilted_and_turned_camera_looks():
    side, rays, rotations = 8, AROUND.rays(8), AROUND.rotations()
    for rotation, direction in zip(rotations, AROUND.directions, strict=True):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        for x, y in ((0, 0), (7, 0), (3, 6)):
            wanted = slow_view_ray(direction, 80.0, side, x, y)
            np.testing.assert_allclose(rays[y, x] @ rotation, wanted, atol=1e-12)


def test_a_direction_is_seen_where_the_ray_of_the_pixel_looks():
    side, rotations = 8, AROUND.rotations()
    for number, rotation in enumerate(rotations):
        for x, y in ((0, 7), (3, 4)):
            found = AROUND.seen_at(AROUND.rays(side)[y, x] @ rotation, side)
            assert found is not None and found[0] == number
            np.testing.assert_allclose(found[1], [x, y], atol=1e-9)
    level = ViewSet((Direction(0, 0), Direction(180, 0)), 90.0)
    assert level.seen_at(np.asarray([0.1, -2.0, 1.0]), side) is None
    assert level.seen_at(np.asarray([0.0, -1.0, 0.0]), side) is None


def test_some_rows_of_a_view_are_a_part_of_it():
    whole = AROUND.rays(8, samples=3)
    np.testing.assert_array_equal(AROUND.rays(8, samples=3, rows=slice(2, 5)), whole[6:15])


def test_the_outer_borders_of_a_view_are_its_field_of_view_apart():
    """The border lies half a pixel beyond the centre of the last one."""
    focal = AROUND.focal(100)
    assert 2 * np.degrees(np.arctan(50 / focal)) == pytest.approx(80)
    half = 0.5 / focal
    left, right = AROUND.rays(100)[50, [0, -1], 0] + [-half, half]
    assert np.degrees(np.arctan(right) - np.arctan(left)) == pytest.approx(80)


def test_samples_of_a_pixel_lie_evenly_around_its_centre():
    fine = AROUND.rays(5, samples=4).reshape(5, 4, 5, 4, 3)
    np.testing.assert_allclose(fine.mean((1, 3)), AROUND.rays(5), atol=1e-12)


def test_a_view_is_as_fine_at_its_centre_as_the_panorama_at_its_equator():
    side = AROUND.side(6000, most=10**6)
    assert AROUND.focal(side) == pytest.approx(6000 / (2 * np.pi), rel=1e-3)
    assert AROUND.side(6000, most=800) == 800


def test_rows_near_the_poles_have_more_pixels_for_the_same_width():
    found = rows_per_pixel(180)
    assert found[89] == pytest.approx(1, abs=1e-3)
    assert found[29] == pytest.approx(1 / np.cos(np.radians(60.5)))
    np.testing.assert_allclose(found, found[::-1])


@pytest.mark.parametrize("fov", [0.0, 180.0])
def test_a_pinhole_view_sees_less_than_half_of_the_sphere(fov):
    with pytest.raises(ValueError, match=f"between 0 and 180; got {fov}"):
        ViewSet((Direction(0, 0),), fov)
