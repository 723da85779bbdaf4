"""Measured positions in COLMAP's database, as COLMAP reads them."""

import numpy as np
import pycolmap
import pytest

from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.pose_priors import VERTICAL, write_pose_priors
from jaxsfm.io.position_tables import Position


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
