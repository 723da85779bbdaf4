"""Measured positions: in metres, against the formulas of geodesy; and in COLMAP's database."""

import numpy as np
import pycolmap
import pytest

from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.measured_positions import VERTICAL, east_north_up, write_pose_priors
from jaxsfm.io.position_tables import Position

A, F = 6378137.0, 1 / 298.257223563


def priors(path) -> dict[str, pycolmap.PosePrior]:
    with pycolmap.Database.open(path) as db:
        names = {image.data_id: image.name for image in db.read_all_images()}
        return {names[each.corr_data_id]: each for each in db.read_all_pose_priors()}


@pytest.mark.parametrize("geographic", [True, False])
def test_each_image_has_its_prior_and_no_other_has_one(tmp_path, scene, geographic):
    path = tmp_path / "d.db"
    write_database(path, scene.images, scene.results, scene.cameras)
    first, second, third = scene.names[:3]
    given = {
        first: Position(7.5, 46.5, 300.0, 0.5),
        second: Position(7.25, 46.25, 301.0),
        third: Position(7.0, 46.0, None),
        "a stranger.jpg": Position(1.0, 2.0, 3.0),
    }
    for _ in range(2):  # a second call replaces the priors of the first
        write_pose_priors(path, given, geographic=geographic)
        found = priors(path)
        assert found.keys() == {first, second}
    expected = [46.5, 7.5, 300] if geographic else [7.5, 46.5, 300]
    assert found[first].position.tolist() == expected
    np.testing.assert_allclose(
        found[first].position_covariance, np.diag([0.25, 0.25, 0.25 * VERTICAL**2])
    )
    assert found[first].has_position_cov() and not found[second].has_position_cov()
    systems = pycolmap.PosePriorCoordinateSystem
    kinds = {each.coordinate_system for each in found.values()}
    assert kinds == {systems.WGS84 if geographic else systems.CARTESIAN}


def ecef(lon, lat, height):
    """Earth-centred coordinates: the textbook formula (e.g. Torge, Geodesy, 4.27)."""
    lon, lat = np.radians(lon), np.radians(lat)
    e2 = F * (2 - F)
    n = A / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    across = (n + height) * np.cos(lat)
    up = (n * (1 - e2) + height) * np.sin(lat)
    return np.asarray([across * np.cos(lon), across * np.sin(lon), up])


@pytest.mark.parametrize("origin", [(46.84, -91.99, 198.6), (-33.9, 151.2, 0.0), (0.5, 0.2, -20.0)])
def test_metres_east_north_and_up_are_those_of_the_tangent_plane(origin):
    rng = np.random.default_rng(0)
    lat, lon, height = origin
    given = np.asarray([lon, lat, height]) + rng.normal(size=(20, 3)) * [0.01, 0.01, 50]
    la, lo = np.radians([lat, lon])
    axes = np.asarray(
        [
            [-np.sin(lo), np.cos(lo), 0],
            [-np.sin(la) * np.cos(lo), -np.sin(la) * np.sin(lo), np.cos(la)],
            [np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)],
        ]
    )
    start = ecef(lon, lat, height)
    expected = [axes @ (ecef(*each) - start) for each in given]
    np.testing.assert_allclose(east_north_up(given, origin), expected, atol=1e-6)


def test_east_is_positive_for_larger_longitudes_and_up_for_larger_heights():
    here = np.asarray([[10.0, 50.0, 100.0]])
    moved = [here + step for step in ([1e-4, 0, 0], [0, 1e-4, 0], [0, 0, 5])]
    for axis, place in enumerate(moved):
        found = east_north_up(place, (50.0, 10.0, 100.0))[0]
        assert found[axis] > 4 and np.abs(np.delete(found, axis)).max() < 1e-3
