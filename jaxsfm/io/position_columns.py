"""How the tables of other tools name their columns, and lines whose file names have blanks.

Known are the headers of Agisoft Metashape (`#Label,X/Longitude,Y/Latitude,Z/Altitude`), Pix4D
(`imagename,latitude [decimal degrees],...`, `imageName X Y Z`), RealityCapture
(`#name,x,y,alt`), OpenDroneMap (`geo_x geo_y geo_z im_x im_y image_name`) and ExifTool
(`SourceFile,GPSLatitude,...`). Case, units in brackets and the order of the columns do not matter.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxsfm.io.photo_folder import SUFFIXES

_DELIMITERS = ",;\t"
_ALIASES = {
    "image": (
        *("images", "image name", "imagename", "image file", "file name", "filename", "file"),
        *("photo", "photo name", "source file", "sourcefile", "camera name", "cameraname"),
        *("camera", "label", "name"),
    ),
    "lat": ("latitude", "gps latitude", "gpslatitude", "y/latitude"),
    "lon": ("lng", "long", "longitude", "gps longitude", "gpslongitude", "x/longitude"),
    "alt": ("altitude", "gps altitude", "gpsaltitude", "z/altitude", "height", "elevation", "z"),
    "x": ("easting", "east", "x/easting", "x/east", "geo x"),
    "y": ("northing", "north", "y/northing", "y/north", "geo y"),
    "z": ("height", "altitude", "alt", "elevation", "up", "z/altitude", "z/height", "geo z"),
    "deviation": ("accuracy horizontal", "horizontal accuracy"),
    "point": ("point name", "gcp", "gcp name", "marker", "marker name"),
    "px": ("pixel x", "im x", "image x"),
    "py": ("pixel y", "im y", "image y"),
}
"""Other names of our columns, in lower case, with blanks for underscores and without units. A
column with our own name is preferred, then one whose name comes first."""
_SUFFIX = "|".join(re.escape(suffix) for suffix in sorted(SUFFIXES))
_NAME = re.compile(rf"(.*?(?:{_SUFFIX}))(?:\s+(.*))?", re.IGNORECASE)
"""A file name with blanks, up to the suffix of photos, and what follows it."""


class Columns(NamedTuple):
    """The first line of a table."""

    names: list[str]
    """As the file writes them, in lower case."""
    delimiter: str | None
    """None: fields are separated by blanks."""
    ours: Mapping[str, int]
    """Where our columns are."""

    @property
    def geographic(self) -> bool:
        """Whether positions are longitude and latitude."""
        own = set(self.names)
        if {"lat", "lon"} <= own or {"x", "y"} <= own:
            return {"lat", "lon"} <= own
        return {"lat", "lon"} <= self.ours.keys()

    @property
    def located(self) -> bool:
        """Whether there are columns of positions."""
        return self.geographic or {"x", "y"} <= self.ours.keys()

    @property
    def of_points(self) -> bool:
        """Whether the table lists control points."""
        return "point" in self.names or {"point", "px", "py"} <= self.ours.keys()

    def fields(self, line: str) -> list[str]:
        """The fields of a line. A file name may have blanks where blanks separate fields."""
        if self.delimiter is not None:
            return next(csv.reader([line], delimiter=self.delimiter))
        found = line.split()
        more, at = len(found) - len(self.names), self.ours["image"]
        if more > 0:
            found[at : at + more + 1] = [" ".join(found[at : at + more + 1])]
        return found

    def named(self, fields: Sequence[str]) -> dict[str, str]:
        """The fields of our columns by their names."""
        given = {name: fields[k] for name, k in self.ours.items()}
        unused = ("x", "y", "z") if self.geographic else ("lat", "lon", "alt")
        return {name: text for name, text in given.items() if name not in unused}


def columns_of(line: str) -> Columns | None:
    """The columns that a line lists; None if it is no list of columns."""
    delimiter = next((each for each in _DELIMITERS if each in line), None)
    split = next(csv.reader([line], delimiter=delimiter)) if delimiter else line.split()
    names = [name.strip().lower() for name in split]
    plain = [_plain(name) for name in names]
    ours = {}
    for name, aliases in _ALIASES.items():
        places = [names.index(name)] if name in names else []
        places += [plain.index(alias) for alias in (name, *aliases) if alias in plain]
        if places:
            ours[name] = places[0]
    found = Columns(names, delimiter, ours)
    if "image" in names and (delimiter or len(names) == 1):
        return found
    return found if "image" in ours and found.located else None


def _plain(name: str) -> str:
    """A name without the unit, with single blanks between its words."""
    bare = re.sub(r"[\[(].*?[\])]", " ", name)
    return " ".join(bare.replace("_", " ").split())


def camera_fields(line: str) -> list[str]:
    """The name of a photo, and the fields that follow it, which blanks or tabs separate."""
    first, tab, others = line.partition("\t")
    if tab and is_number(others.split()[0]):
        return [_unquoted(first), *others.split()]
    named = _NAME.fullmatch(line)
    if named and named[2] and is_number(named[2].split()[0]):
        return [_unquoted(named[1]), *named[2].split()]
    return line.split()


def point_fields(line: str) -> list[str]:
    """x, y, z, px, py, the name of a photo, and the name of the point, if the line has one."""
    *numbers, text = line.split(maxsplit=5)
    tabbed = [part.strip() for part in text.split("\t") if part.strip()]
    if len(tabbed) > 1 and _is_one_name(tabbed[0]):
        return [*numbers, _unquoted(tabbed[0]), tabbed[1]]
    named = _NAME.fullmatch(text)
    if named is None:
        return line.split()
    return [*numbers, _unquoted(named[1]), *(named[2] or "").split()[:1]]


def begins_with_point(line: str) -> bool:
    """Whether a line begins with the numbers of a control point, and not with a photo's name."""
    fields = line.split()
    if not is_number(fields[0]):
        return False
    if len(fields) >= 5 and all(map(is_number, fields[:5])):
        return True
    camera = camera_fields(line)
    return not (len(camera) > 2 and len(camera) < len(fields) and is_number(camera[2]))


def is_number(text: str) -> bool:
    """Whether a text is a number, or `nan`."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_one_name(text: str) -> bool:
    named = _NAME.fullmatch(text)
    return len(text.split()) == 1 or (named is not None and not named[2])


def _unquoted(name: str) -> str:
    return name.strip().strip('"')
