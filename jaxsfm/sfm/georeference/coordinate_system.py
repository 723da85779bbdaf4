"""The coordinate systems of measured positions, and the frame of metres that models get.

Longitude and latitude of WGS 84 need nothing beyond COLMAP. Every other system of the Earth is
looked up with pyproj, which is an optional package.
"""

import dataclasses
import re
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from jaxsfm.colmap.measured_positions import east_north_up
from jaxsfm.errors import UserError
from jaxsfm.io.extras import extra
from jaxsfm.io.images import shown_name
from jaxsfm.io.position_tables import OPTION

if TYPE_CHECKING:
    import pyproj

Kind = Literal["geographic", "projected", "local"]
FAR = 10_000.0
"""Local coordinates beyond this many metres get an offset. There float32, in which many formats
store points, has steps of a millimetre."""
BEYOND = 1.0
"""Surveys at the border of a projection's region keep its coordinates, but not farther than so many
degrees, 111 km: there the next zone has another scale."""
_GEOGRAPHIC = ("epsg:4326", "epsg:4979", "wgs84", "wgs 84")
_UTM = re.compile(
    r"(?:WGS[ _]?(?:19)?84|(ETRS[ _]?(?:19)?89))?[ /_]*UTM[ _]*(?:zone)?[ _]*(\d{1,2})[ _]*"
    r"([NS])(?:orth|outh)?",
    re.IGNORECASE,
)
_CODE = re.compile(r"EPSG\s*:{0,2}\s*(\d+)", re.IGNORECASE)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Frame:
    """The frame of a model in metres: its axes, and where its origin lies."""

    axes: Literal["east, north, up", "easting, northing, height", "x, y, z"]
    system: str | None
    """The coordinate system of the measured positions; None if they are metres along any axes."""
    origin: tuple[float, float, float] | None
    """Latitude, longitude (degrees, WGS 84) and height (metres) of the model's origin; None if it
    is not known. The height is of the kind that was measured: above sea level, or the ellipsoid."""
    offset: tuple[float, float, float]
    """What was subtracted from easting, northing and height, or from x, y and z, metres."""


class CoordinateSystem(NamedTuple):
    """The coordinate system of measured positions."""

    kind: Kind
    name: str | None
    """As the user wrote it."""
    crs: "pyproj.CRS | None"
    """Its definition, if it needs pyproj."""
    metres: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """The units of the three coordinates of a projection, in metres."""

    def check(self, xyz: np.ndarray) -> None:
        """Raise UserError unless all positions float64 (n, 3) lie in this system."""
        if self.kind != "local":
            self._wgs84(xyz)

    def covers(self, xyz: np.ndarray) -> bool:
        """Whether all positions float64 (n, 3) lie in the region that this projection is made for,
        or at most `BEYOND` degrees from it; False if it is not known."""
        try:
            return self.around(self._wgs84(xyz))
        except UserError:
            return False

    def around(self, lon_lat: np.ndarray) -> bool:
        """The same of longitudes and latitudes: the first two columns."""
        area = None if self.crs is None else self.crs.area_of_use
        if area is None:
            return False
        lon, lat = lon_lat[:, 0], lon_lat[:, 1]
        east = (lon - area.west + BEYOND) % 360  # a region may cross the 180th meridian
        inside = (east <= (area.east - area.west) % 360 + 2 * BEYOND) & (
            (lat >= area.south - BEYOND) & (lat <= area.north + BEYOND)
        )
        return bool(inside.all())

    def frame(self, xyz: np.ndarray) -> Frame:
        """The frame whose origin lies amid positions float64 (n, 3), n >= 1, in this system."""
        middle = np.median(xyz, axis=0)
        if self.kind == "geographic":
            lon, lat, height = self._wgs84(middle[None])[0].tolist()
            origin = (lat, lon, height)
            return Frame(axes="east, north, up", system=self.name, origin=origin, offset=(0, 0, 0))
        if self.kind == "projected":
            offset = np.round(middle * self.metres)
            lon, lat, _ = self._wgs84(offset[None] / self.metres)[0].tolist()
            east, north, height = offset.tolist()
            return Frame(
                axes="easting, northing, height",
                system=self.name,
                origin=(lat, lon, height),
                offset=(east, north, height),
            )
        far = np.abs(xyz).max() > FAR
        x, y, z = np.round(middle).tolist() if far else (0.0, 0.0, 0.0)
        return Frame(axes="x, y, z", system=None, origin=None, offset=(x, y, z))

    def into(self, frame: Frame, xyz: np.ndarray) -> np.ndarray:
        """Positions float64 (n, 3) of this system in a frame that `frame` made, metres."""
        if self.kind == "geographic":
            assert frame.origin is not None
            return east_north_up(self._wgs84(xyz), frame.origin)
        return xyz * self.metres - np.asarray(frame.offset)

    def _wgs84(self, xyz: np.ndarray) -> np.ndarray:
        """Positions as longitude, latitude and height of WGS 84."""
        if self.crs is None:
            return xyz
        import pyproj

        to = pyproj.Transformer.from_crs(self.crs, pyproj.CRS("EPSG:4979"), always_xy=True)
        moved = np.stack(to.transform(*xyz.T), axis=1)
        if not np.isfinite(moved).all():
            bad = xyz[~np.isfinite(moved).all(1)][0]
            raise UserError(
                f"{OPTION}: the position ({bad[0]:g}, {bad[1]:g}) lies outside {self.name}; are "
                "its first two numbers in the right order?"
            )
        return moved


LOCAL = CoordinateSystem("local", None, None)
"""Metres along any three axes at right angles."""
GPS = CoordinateSystem("geographic", "EPSG:4326", None)
"""Longitude and latitude of WGS 84."""


def coordinate_system(text: str | None, where: str) -> CoordinateSystem:
    """The coordinate system that a text names; None stands for metres along any axes.

    Args:
      text: EPSG:code, `WGS84 UTM 32N`, a string of PROJ, or what else pyproj knows.
      where: the option and the file, for messages.

    Raises:
      UserError: pyproj is needed and not installed, it does not know the system, or the system is
        neither one of longitude and latitude nor a projection.
    """
    if text is None:
        return LOCAL
    tokens = set(text.lower().split())
    plain_wgs84 = {"+proj=longlat", "+proj=latlong"} & tokens and "+datum=wgs84" in tokens
    if text.strip().lower() in _GEOGRAPHIC or plain_wgs84:
        return CoordinateSystem("geographic", text, None)
    with extra("geo", f"{where}: the coordinate system {shown_name(text)} needs"):
        import pyproj
        from pyproj.exceptions import CRSError
    try:
        crs = pyproj.CRS(_code(text))
    except CRSError as error:
        raise UserError(f"{where}: {shown_name(text)} is no known coordinate system") from error
    if crs.is_geographic:
        return CoordinateSystem("geographic", text, crs)
    if not crs.is_projected:
        raise UserError(f"{where}: {shown_name(text)} is not a projection")
    units = [axis.unit_conversion_factor for axis in crs.axis_info]
    if not (len(units) in (2, 3) and units[0] == units[1] and min(units) > 0):
        raise UserError(f"{where}: the axes of {shown_name(text)} must have one unit of length")
    # Heights have the unit of the projection, unless the system has a unit for them.
    return CoordinateSystem("projected", text, crs, (units[0], units[0], units[-1]))


def _code(text: str) -> str:
    """The name of a coordinate system as pyproj knows it."""
    if utm := _UTM.fullmatch(text.strip()):
        zone, south = int(utm[2]), utm[3].upper() == "S"
        if utm[1] and not south:
            return f"EPSG:{25800 + zone}"
        return f"EPSG:{32600 + zone + 100 * south}"
    if code := _CODE.fullmatch(text.strip()):
        return f"EPSG:{code[1]}"
    return text
