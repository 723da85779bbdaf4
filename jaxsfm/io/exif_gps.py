"""The position that a camera wrote into its photo: EXIF's GPS fields.

Source: CIPA DC-008-2023 (EXIF 3.0), section 4.6.6.
"""

import math
import warnings
from collections.abc import Iterable, Mapping

from PIL import ExifTags

from jaxsfm.io.decoders import any_size, open_header
from jaxsfm.io.images import ImageError, ImageFile, image_bytes
from jaxsfm.io.position_tables import Position

METRES_PER_DOP = 5.0
"""The error of a range to a satellite, metres. A dilution of precision (GPSDOP) times this is the
expected deviation of the position. It is a rule of thumb for receivers without corrections."""
Tag = ExifTags.GPS


def read_gps(images: Iterable[ImageFile]) -> dict[str, Position]:
    """The positions that photos carry, by name; photos without a usable one are left out.

    x is the longitude and y is the latitude, degrees (WGS 84). z is the altitude, metres, as the
    camera gives it: usually above sea level. It is None if the photo has none.
    """
    found = {image.name: gps_of(image) for image in images}
    return {name: position for name, position in found.items() if position is not None}


def gps_of(image: ImageFile) -> Position | None:
    """The position that a photo carries; None if it has none, or one that no camera can have."""
    try:
        data = image_bytes(image)
    except ImageError:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about odd metadata
            # Pillow is given the bytes: reading from a file, it allocates what the header says.
            with any_size(), open_header(data, image.path.suffix) as opened:
                fields = dict(opened.getexif().get_ifd(ExifTags.IFD.GPSInfo))
    except Exception:  # Pillow's readers can raise almost anything on damaged metadata
        return None
    return position_of(fields)


def position_of(fields: Mapping[int, object]) -> Position | None:
    """The position in the fields of EXIF's GPS directory, by tag."""
    lat = _angle(fields.get(Tag.GPSLatitude), fields.get(Tag.GPSLatitudeRef), "N", "S", 90)
    lon = _angle(fields.get(Tag.GPSLongitude), fields.get(Tag.GPSLongitudeRef), "E", "W", 180)
    if lat is None or lon is None:
        return None
    if lat == 0 and lon == 0:  # what receivers write that have no fix; it lies in the Atlantic
        return None
    return Position(lon, lat, _altitude(fields), _deviation(fields))


def _number(value: object) -> float | None:
    """A number of EXIF; None if it is none. A rational with a zero denominator is not finite."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


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
    side = _letter(reference)
    if side not in (positive, negative) or not isinstance(value, list | tuple):
        return None
    parts = [_number(part) for part in value]
    if len(parts) != 3 or None in parts:
        return None
    degrees, minutes, seconds = (part for part in parts if part is not None)
    if min(degrees, minutes, seconds) < 0 or minutes > 60 or seconds > 60:
        return None
    angle = degrees + minutes / 60 + seconds / 3600
    if angle > largest:
        return None
    return angle if side == positive else -angle


def _altitude(fields: Mapping[int, object]) -> float | None:
    """Metres; negative below the reference (GPSAltitudeRef 1: sea level, 3: the ellipsoid)."""
    altitude = _number(fields.get(Tag.GPSAltitude))
    reference = fields.get(Tag.GPSAltitudeRef, 0)
    if isinstance(reference, bytes):
        reference = reference[0] if reference else 0
    return altitude if altitude is None or reference not in (1, 3) else -altitude


def _deviation(fields: Mapping[int, object]) -> float | None:
    """The expected horizontal error, metres; None if the camera does not give it."""
    error = _number(fields.get(Tag.GPSHPositioningError))
    if error is not None and error > 0:
        return error
    dilution = _number(fields.get(Tag.GPSDOP))
    return dilution * METRES_PER_DOP if dilution is not None and dilution > 0 else None
