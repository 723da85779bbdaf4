"""Measured camera positions: on the Earth (WGS 84) in metres, and in COLMAP's database, where other
tools find them."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.database import changed
from jaxsfm.io.position_tables import Position

VERTICAL = 2.0
"""The expected vertical error of a receiver is the horizontal one times this: a rule of thumb."""


def write_pose_priors(
    database: Path, positions: Mapping[str, Position], *, geographic: bool
) -> None:
    """Replace the pose priors of a database by measured positions.

    COLMAP's priors have three coordinates, so positions without a height are left out.

    Args:
      positions: by the name of the image; other names are ignored.
      geographic: whether they are longitude and latitude. COLMAP's order is latitude, longitude.
    """
    systems = pycolmap.PosePriorCoordinateSystem
    with changed(database) as db:
        db.clear_pose_priors()
        for image in sorted(db.read_all_images(), key=lambda image: image.name):
            at = positions.get(image.name)
            if at is None or at.z is None:
                continue
            prior = pycolmap.PosePrior(
                corr_data_id=image.data_id,
                position=[at.y, at.x, at.z] if geographic else [at.x, at.y, at.z],
                coordinate_system=systems.WGS84 if geographic else systems.CARTESIAN,
            )
            if at.deviation is not None:
                variance = at.deviation**2
                prior.position_covariance = np.diag([variance, variance, VERTICAL**2 * variance])
            db.write_pose_prior(prior)


def east_north_up(lon_lat_height: np.ndarray, origin: tuple[float, float, float]) -> np.ndarray:
    """Metres east, north and up of an origin, on the plane that touches the ellipsoid there.

    Args:
      lon_lat_height: float64 (n, 3): degrees, degrees, metres above the ellipsoid.
      origin: latitude, longitude (degrees) and height (metres) of the origin.
    """
    if not len(lon_lat_height):
        return np.zeros((0, 3))
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    lat_lon = np.ascontiguousarray(lon_lat_height[:, [1, 0, 2]], np.float64)
    return np.asarray(transform.ellipsoid_to_enu(lat_lon, *origin))
