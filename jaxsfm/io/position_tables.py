"""Files of measured positions: where cameras stood, or where points on the ground are.

Two layouts are read. OpenDroneMap's text files (gcp_list.txt, geo.txt) begin with a line that names
the coordinate system; fields are separated by blanks. Other tables begin with the names of their
columns; a line that names the coordinate system may come before them. See docs/formats.md.

Source: https://docs.opendronemap.org/gcp/ and https://docs.opendronemap.org/geo/.
"""

import dataclasses
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import listed_lines
from jaxsfm.io.position_columns import (
    Columns,
    begins_with_point,
    camera_fields,
    columns_of,
    is_number,
    point_fields,
)
from jaxsfm.io.written_coordinates import Coordinates, Written, neighbourhood, written

OPTION = "--georeference"
WGS84 = "EPSG:4326"
"""The coordinate system of latitude and longitude that GPS uses."""
_SYSTEM = re.compile(
    r"epsg\b|epsg\d|\+|wgs ?_?(19)?84|utm|etrs|urn:ogc|(proj|geog|geod|compd|compound)(cs|crs)",
    re.IGNORECASE,
)
"""How a line begins that names a coordinate system."""
_METASHAPES = re.compile(r"CoordinateSystem:\s*(.+)")


class Position(NamedTuple):
    """A measured position of a camera."""

    x: float
    """East: metres, or the longitude in degrees."""
    y: float
    """North: metres, or the latitude in degrees."""
    z: float | None
    """Up, metres; None if it was not measured."""
    deviation: float | None = None
    """The expected horizontal error, metres; None if it is not known."""

    @property
    def full(self) -> bool:
        """Whether the height was measured."""
        return self.z is not None


class Measurement(NamedTuple):
    """Where a photo shows a control point."""

    image: str
    """The name of the photo, as the file writes it."""
    x: float
    """Original pixels; the centre of the top-left pixel is (0, 0)."""
    y: float
    line: int
    """The line of the file, for messages."""


@dataclass(frozen=True, kw_only=True)
class ControlPoint:
    """A point with a measured position, and the photos that show it."""

    name: str
    position: Position
    seen: list[Measurement] = field(default_factory=list)

    @property
    def photos(self) -> list[str]:
        """The names of the photos that show it."""
        return [each.image for each in self.seen]


@dataclass(frozen=True, kw_only=True)
class PositionTable:
    """What a file of positions holds: positions of photos, or control points."""

    system: str | None
    """The coordinate system as the file names it; None for metres along any three axes."""
    positions: dict[str, Position] = field(default_factory=dict)
    """By the name of the photo, as the file writes it."""
    points: list[ControlPoint] = field(default_factory=list)


class _Row(NamedTuple):
    """A line of a table, its fields by the name of their column."""

    where: str
    line: int
    fields: dict[str, str]

    def number(self, name: str) -> Written:
        """The number in a column; UserError if there is none."""
        text = self.fields.get(name, "").strip()
        try:  # where no comma separates fields, one may stand for the point
            found = written(text.replace(",", ".", 1))
        except ValueError:
            raise UserError(f"{self.where}: {name} must be a number; got {text!r}") from None
        if not math.isfinite(found.value):
            raise UserError(f"{self.where}: {name} must be finite; got {text!r}")
        return found

    def optional(self, name: str) -> Written | None:
        """The number in a column; None if it is empty, nan, or not there."""
        text = self.fields.get(name, "").strip()
        return None if text.lower() in ("", "nan") else self.number(name)

    def coordinates(self) -> Coordinates:
        """x, y and z, with longitude and latitude as x and y."""
        geographic = "lat" in self.fields
        x, y, z = ("lon", "lat", "alt") if geographic else ("x", "y", "z")
        return Coordinates(self.number(x), self.number(y), self.optional(z))

    def deviation(self) -> float | None:
        """The expected error; None if it is not known."""
        found = self.optional("deviation")
        if found is not None and found.value <= 0:
            raise UserError(f"{self.where}: deviation must be positive; got {found.value:g}")
        return None if found is None else found.value

    def position(self) -> Position:
        """The position in the row."""
        return Position(*self.coordinates().values, self.deviation())


def read_position_table(path: Path) -> PositionTable:
    """Read a file of camera positions or of ground control points.

    Raises:
      UserError: the file cannot be read, or a line of it is not what the layout asks for.
    """
    where = f"{OPTION} {path}"
    lines = listed_lines(path, OPTION)
    if not lines:
        raise UserError(f"{where}: the file is empty")
    system = None
    if _SYSTEM.match(lines[0][1]) and columns_of(lines[0][1]) is None:
        system, lines = lines[0][1], lines[1:]
        if not lines:
            raise UserError(f"{where}: there is nothing below the coordinate system")
    columns = columns_of(lines[0][1])
    if columns is not None:
        return _read_csv(lines[1:], columns, system, where)
    if system is not None:
        return _read_blanks(lines, system, where)
    columns, system = _in_comments(path)
    if columns is None:
        raise UserError(
            f"{where}: the first line must name a coordinate system (EPSG:4326, WGS84 UTM 32N, "
            "+proj=...) or the columns image,lat,lon,alt or image,x,y,z or "
            "point,x,y,z,image,px,py"
        )
    return _read_csv(lines, columns, system, where)


def _in_comments(path: Path) -> tuple[Columns | None, str | None]:
    """The columns and the coordinate system that comments name, as Metashape writes them."""
    columns, system = None, None
    for line in path.read_text(encoding="utf-8-sig").splitlines():
        if line.startswith("#"):
            text = line.strip("# \t")
            if named := _METASHAPES.match(text):
                system = named[1]
            columns = columns or columns_of(text)
    if system is not None and system.startswith("LOCAL_CS"):
        system = None
    return columns, system


def _read_csv(
    lines: list[tuple[int, str]], columns: Columns, system: str | None, where: str
) -> PositionTable:
    names = columns.names
    if not columns.located:
        raise UserError(f"{where}: needs the columns lat, lon, alt or x, y, z; got {names}")
    if columns.geographic:
        system = system or WGS84
    rows = []
    for number, line in lines:
        fields = columns.fields(line)
        if len(fields) != len(names):
            raise UserError(
                f"{where}, line {number}: must have {len(names)} fields, as its first line; got "
                f"{len(fields)}"
            )
        rows.append(_Row(f"{where}, line {number}", number, columns.named(fields)))
    if columns.of_points:
        if not {"px", "py"} <= columns.ours.keys():
            raise UserError(f"{where}: control points need the columns px and py; got {names}")
        return PositionTable(system=system, points=_points(rows))
    return PositionTable(system=system, positions=_positions(rows))


def _read_blanks(lines: list[tuple[int, str]], system: str, where: str) -> PositionTable:
    """OpenDroneMap's files: a line begins with a number in gcp_list.txt, and with a photo in
    geo.txt."""
    points, cameras = [], []
    for number, line in lines:
        at = f"{where}, line {number}"
        if not begins_with_point(line):
            names = ("image", "x", "y", "z", "yaw", "pitch", "roll", "deviation")
            fields = camera_fields(line)
            if len(fields) < 3:
                raise UserError(f"{at}: must be image x y [z ...]; got {shown_name(line)!r}")
            named = dict[str, str](zip(names, fields, strict=False))
            if is_number(named.get("deviation", "")) and float(named["deviation"]) <= 0:
                del named["deviation"]
            cameras.append(_Row(at, number, named))
            continue
        count = len(line.split())
        if count < 6:
            raise UserError(
                f"{at}: must be x y z px py image [name]; got {count} fields: {shown_name(line)!r}"
            )
        fields = point_fields(line)
        names = ("x", "y", "z", "px", "py", "image")
        named = dict[str, str](zip(names, fields, strict=False))
        if len(fields) > 6:
            named["point"] = fields[6]
        points.append(_Row(at, number, named))
    if points and cameras:
        raise UserError(
            f"{where}: lines must all begin with a number (control points) or all with a photo "
            f"(camera positions); got {len(points)} and {len(cameras)}"
        )
    return PositionTable(system=system, positions=_positions(cameras), points=_points(points))


def _positions(rows: list[_Row]) -> dict[str, Position]:
    found: dict[str, Position] = {}
    for row in rows:
        name = row.fields["image"].strip()
        if name in found:
            raise UserError(f"{row.where}: {shown_name(name)} has a position already")
        found[name] = row.position()
    return found


def _points(rows: list[_Row]) -> list[ControlPoint]:
    found: dict[str, ControlPoint] = {}
    known: dict[str, Coordinates] = {}
    unnamed: dict[str, str] = {}  # names of points by the text of their coordinates
    if not rows:
        return []
    most = neighbourhood([row.coordinates() for row in rows])
    for row in rows:
        at, deviation, image = row.coordinates(), row.deviation(), row.fields["image"].strip()
        if "point" in row.fields:
            name = row.fields["point"].strip()
        else:  # the point is known by its coordinates, and no photo shows it twice
            text = " ".join(row.fields[axis] for axis in "xyz")
            if text not in unnamed:
                others = (each for each in unnamed.values() if image not in found[each].photos)
                same = (each for each in others if at.rounds(known[each], most))
                unnamed[text] = next(same, text)
            name = unnamed[text]
        first = ControlPoint(name=name, position=Position(*at.values, deviation))
        point, before = found.setdefault(name, first), known.setdefault(name, at)
        if "point" in row.fields and not (
            at.equal(before) and deviation == point.position.deviation
        ):
            raise UserError(
                f"{row.where}: the point {shown_name(name)} has another position in an earlier line"
            )
        if image in point.photos:
            raise UserError(
                f"{row.where}: the point {shown_name(name)} is measured twice in "
                f"{shown_name(image)}"
            )
        known[name] = before.finest(at)
        px, py = row.number("px").value, row.number("py").value
        point.seen.append(Measurement(image, px, py, row.line))
    return [
        dataclasses.replace(point, position=Position(*known[name].values, point.position.deviation))
        for name, point in found.items()
    ]
