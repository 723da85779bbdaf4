"""The position that a camera wrote into its photo: EXIF's GPS fields.

Source: CIPA DC-008-2023 (EXIF 3.0), section 4.6.6.
"""

import logging
from collections.abc import Iterable, Mapping

from PIL import ExifTags

from jaxsfm.io.exif_camera import number
from jaxsfm.io.images import ImageError, ImageFile, exif_data, named
from jaxsfm.io.position_tables import Position

METRES_PER_DOP = 5.0
"""The error of a range to a satellite, metres. A dilution of precision (GPSDOP) times this is the
expected deviation of the position. It is a rule of thumb for receivers without corrections."""
LOWEST, HIGHEST = -11_000.0, 100_000.0
"""Altitudes that photos are taken at, metres: from the deepest sea to the border of space."""
Tag = ExifTags.GPS
logger = logging.getLogger("jaxsfm")


def read_gps(images: Iterable[ImageFile]) -> dict[str, Position]:
    """The positions that photos carry, by name; photos without a usable one are left out.

    x is the longitude and y is the latitude, degrees (WGS 84). z is the altitude, metres, as the
    camera gives it: usually above sea level. It is None if the photo has none.
    """
    found, doubts = {}, dict[str, list[str]]()
    for image in images:
        fields = _fields_of(image)
        if (position := position_of(fields)) is not None:
            found[image.name] = position
        if (doubt := _doubt(fields)) is not None:
            doubts.setdefault(doubt, []).append(image.name)
    for tag, names in doubts.items():
        logger.warning("%s: EXIF is not believed about %s, so it is not used", named(names), tag)
    return found


def gps_of(image: ImageFile) -> Position | None:
    """The position that a photo carries; None if it has none, or one that no camera can have."""
    return position_of(_fields_of(image))


def _fields_of(image: ImageFile) -> Mapping[int, object]:
    try:
        return exif_data(image).gps
    except ImageError:
        return {}


def _doubt(fields: Mapping[int, object]) -> str | None:
    """The first tag whose numbers no place has. Receivers without a fix write no finite ones."""
    for tag, largest in ((Tag.GPSLatitude, 90), (Tag.GPSLongitude, 180)):
        value = fields.get(tag)
        parts = [number(part) for part in value] if isinstance(value, list | tuple) else []
        if len(parts) == 3 and None not in parts and _degrees(value, largest) is None:
            return tag.name
    altitude = number(fields.get(Tag.GPSAltitude))
    return Tag.GPSAltitude.name if altitude is not None and _altitude(fields) is None else None


def position_of(fields: Mapping[int, object]) -> Position | None:
    """The position in the fields of EXIF's GPS directory, by tag."""
    lat = _angle(fields.get(Tag.GPSLatitude), fields.get(Tag.GPSLatitudeRef), "N", "S", 90)
    lon = _angle(fields.get(Tag.GPSLongitude), fields.get(Tag.GPSLongitudeRef), "E", "W", 180)
    if lat is None or lon is None:
        return None
    if lat == 0 and lon == 0:  # what receivers write that have no fix; it lies in the Atlantic
        return None
    return Position(lon, lat, _altitude(fields), _deviation(fields))


def _letter(value: object) -> str:
    """The first letter of a text field, which may be bytes, in upper case."""
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else value
    return text.strip("\0 ")[:1].upper() if isinstance(text, str) else ""


def _angle(
    value: object, reference: object, positive: str, negative: str, largest: float
) -> float | None:
    """Degrees, minutes and seconds as signed degrees; None if they are no angle.

    Without a letter that says on which side of the equator (or of Greenwich) a photo was taken, its
    place is not known.
    """
    side, angle = _letter(reference), _degrees(value, largest)
    if angle is None or side not in (positive, negative):
        return None
    return angle if side == positive else -angle


def _degrees(value: object, largest: float) -> float | None:
    """Degrees, minutes and seconds as degrees; None if they are no angle up to the largest one."""
    if not isinstance(value, list | tuple):
        return None
    parts = [number(part) for part in value]
    if len(parts) != 3 or None in parts:
        return None
    degrees, minutes, seconds = (part for part in parts if part is not None)
    if min(degrees, minutes, seconds) < 0 or minutes > 60 or seconds > 60:
        return None
    angle = degrees + minutes / 60 + seconds / 3600
    return angle if angle <= largest else None


def _altitude(fields: Mapping[int, object]) -> float | None:
    """Metres; negative below the reference (GPSAltitudeRef 1: sea level, 3: the ellipsoid).

    None if there is none, or no photo can be taken there.
    """
    altitude = number(fields.get(Tag.GPSAltitude))
    reference = fields.get(Tag.GPSAltitudeRef, 0)
    if isinstance(reference, bytes):
        reference = reference[0] if reference else 0
    if altitude is None:
        return None
    altitude = -altitude if reference in (1, 3) else altitude
    return altitude if LOWEST <= altitude <= HIGHEST else None


def _deviation(fields: Mapping[int, object]) -> float | None:
    """The expected horizontal error, metres; None if the camera does not give it."""
    error = number(fields.get(Tag.GPSHPositioningError))
    if error is not None and error > 0:
        return error
    dilution = number(fields.get(Tag.GPSDOP))
    return dilution * METRES_PER_DOP if dilution is not None and dilution > 0 else None
