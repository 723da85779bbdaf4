"""Positions on the Earth in metres east, north and up of a place (WGS 84)."""

import numpy as np
import pycolmap


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
