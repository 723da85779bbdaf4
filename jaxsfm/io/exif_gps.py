"""The position that a camera wrote into its photo: EXIF's GPS fields.

What no place on Earth has is not believed: such a photo runs as one without GPS, or without an
altitude. Each reason is named once, with its photos.

Source: CIPA DC-008-2023 (EXIF 3.0), section 4.6.6.
"""

import logging
from collections.abc import Iterable, Mapping

from PIL import ExifTags

from jaxsfm.io.exif_camera import number
from jaxsfm.io.exif_data import exif_data
from jaxsfm.io.images import ImageError, ImageFile, named
from jaxsfm.io.position_tables import Position

METRES_PER_DOP = 5.0
"""The error of a range to a satellite, metres. A dilution of precision (GPSDOP) times this is the
expected deviation of the position. It is a rule of thumb for receivers without corrections."""
LOWEST, HIGHEST = -500.0, 20_000.0
"""Altitudes at which photos with GPS are taken, metres. The lowest shore is that of the Dead Sea,
at -430 m, and satellites are not heard below water or in mines. Many receivers for civil use stop
at 18,000 m, because export rules ask for it, and few aircraft fly higher."""
_PLACE = "GPSLatitude and GPSLongitude"
Tag = ExifTags.GPS
logger = logging.getLogger("jaxsfm")


class _NotBelieved(ValueError):
    """The tag that is not believed and why, in words that are the same for all such photos."""


def read_gps(images: Iterable[ImageFile]) -> dict[str, Position]:
    """The positions that photos carry, by name; photos without a usable one are left out.

    x is the longitude and y is the latitude, degrees (WGS 84). z is the altitude, metres, as the
    camera gives it: usually above sea level. It is None if the photo has none.

    If all photos have one and the same position, none is used. Phones without a fix repeat their
    last one; and photos that were taken at one place say nothing of scale and direction either.
    """
    found, doubts = {}, dict[str, list[str]]()
    for image in images:
        position, doubt = _told(_fields_of(image))
        if position is not None:
            found[image.name] = position
        if doubt is not None:
            doubts.setdefault(doubt, []).append(image.name)
    if len(found) > 1 and len({(at.x, at.y, at.z) for at in found.values()}) == 1:
        doubts[_of_position(f"{_PLACE} (all photos have the same)")] = list(found)
        found = {}
    for doubt, names in doubts.items():
        logger.warning("%s: EXIF is not believed about %s", named(names), doubt)
    return found


def gps_of(image: ImageFile) -> Position | None:
    """The position that a photo carries; None if it has none, or one that no camera can have."""
    return position_of(_fields_of(image))


def _fields_of(image: ImageFile) -> Mapping[int, object]:
    try:
        return exif_data(image).gps
    except ImageError:
        return {}


def position_of(fields: Mapping[int, object]) -> Position | None:
    """The position in the fields of EXIF's GPS directory, by tag."""
    return _told(fields)[0]


def _told(fields: Mapping[int, object]) -> tuple[Position | None, str | None]:
    """The position, None if there is none; and the first tag that is not believed, in words."""
    if fields.get(Tag.GPSLatitude) is None or fields.get(Tag.GPSLongitude) is None:
        return None, None
    try:
        lat = _angle(fields, Tag.GPSLatitude, "NS", 90)
        lon = _angle(fields, Tag.GPSLongitude, "EW", 180)
    except _NotBelieved as why:
        return None, _of_position(str(why))
    if lat == 0 and lon == 0:  # what receivers write that have no fix; it lies in the Atlantic
        return None, _of_position(f"{_PLACE} (0, 0)")
    altitude, doubt = _altitude(fields)
    return Position(lon, lat, altitude, _deviation(fields)), doubt


def _of_position(doubt: str) -> str:
    return f"{doubt}, so the position is not used"


def _letter(value: object) -> str:
    """The first letter of a text field, which may be bytes, in upper case."""
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else value
    return text.strip("\0 ")[:1].upper() if isinstance(text, str) else ""


def _angle(fields: Mapping[int, object], tag: ExifTags.GPS, sides: str, largest: int) -> float:
    """Degrees, minutes and seconds as signed degrees; the second of two sides is negative.

    Without a letter that says on which side of the equator (or of Greenwich) a photo was taken, its
    place is not known. Raises _NotBelieved.
    """
    value = fields[tag]
    parts = [number(part) for part in value] if isinstance(value, list | tuple) else []
    dms = [part for part in parts if part is not None]
    if len(parts) != 3 or len(dms) != 3:
        raise _NotBelieved(f"{tag.name} (not three numbers)")
    if min(dms) < 0:
        raise _NotBelieved(f"{tag.name} (negative; {tag.name}Ref tells the side)")
    if max(dms[1:]) > 60:  # 60 itself is what programs write that round 59.99999
        raise _NotBelieved(f"{tag.name} (more than 60 minutes or seconds)")
    angle = dms[0] + dms[1] / 60 + dms[2] / 3600
    if angle > largest:
        raise _NotBelieved(f"{tag.name} (beyond {largest} degrees)")
    side = _letter(fields.get(tag - 1))  # the tag before an angle's is its reference
    if not side or side not in sides:
        raise _NotBelieved(f"{tag.name}Ref (neither {sides[0]} nor {sides[1]})")
    return angle if side == sides[0] else -angle


def _altitude(fields: Mapping[int, object]) -> tuple[float | None, str | None]:
    """Metres; negative below the reference (GPSAltitudeRef 1: sea level, 3: the ellipsoid).

    None if there is none, or no photo can be taken there; and why it is not believed.
    """
    value, reference = fields.get(Tag.GPSAltitude), fields.get(Tag.GPSAltitudeRef, 0)
    if value is None:
        return None, None
    unused = "so the altitude is not used"
    altitude = number(value)
    if altitude is None:
        return None, f"GPSAltitude (not a number), {unused}"
    if isinstance(reference, bytes):
        reference = reference[0] if reference else 0
    altitude = -altitude if reference in (1, 3) else altitude
    if LOWEST <= altitude <= HIGHEST:
        return altitude, None
    return None, f"GPSAltitude (below {LOWEST:g} m or above {HIGHEST:,.0f} m), {unused}"


def _deviation(fields: Mapping[int, object]) -> float | None:
    """The expected horizontal error, metres; None if the camera does not give it."""
    error = number(fields.get(Tag.GPSHPositioningError))
    if error is not None and error > 0:
        return error
    dilution = number(fields.get(Tag.GPSDOP))
    return dilution * METRES_PER_DOP if dilution is not None and dilution > 0 else None
