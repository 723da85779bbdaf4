"""What EXIF says of the camera of a photo, and how much of that can be.

A few programs write numbers about the lens that no lens has. A focal length made of them is worse
than a guess: the mapper takes it for known. Such tags are left out here, for all who read them.

Source: CIPA DC-008-2023 (EXIF 3.0), section 4.6.5.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from PIL import ExifTags, Image

Tag = ExifTags.Base
FILM_MM = math.hypot(36, 24)
"""The diagonal of 35 mm film, millimetres."""
SHORTEST, LONGEST = 5.0, 2000.0
"""Equivalent focal lengths on 35 mm film that lenses have, millimetres. The widest fisheyes have 5
to 6; telescopes begin at 2000."""
LARGEST_FILM = 10
"""The largest sheets of film, 11 x 14 inches, have a diagonal ten times that of 35 mm film. So no
focal length is longer than this times `LONGEST`."""
EQUIVALENTS_DIFFER = 1.1
"""Equivalents on 35 mm film differ by this factor among makers: some compare diagonals, others
widths, which is 4 % to either side for sensors of 4:3 and of 16:9. A photo that was cut or reduced
by less has no other focal length."""
_PER_MM = {2: 1 / 25.4, 3: 1 / 10, 4: 1.0, 5: 1000.0}
"""The units of a focal plane resolution: inch, centimetre, millimetre and micrometre, as pixels per
millimetre. EXIF has the first two; COLMAP knows the others, too."""
_CAMERA = (Tag.Make, Tag.Model)
_IDENTITY = (
    *_CAMERA,
    Tag.BodySerialNumber,
    Tag.LensModel,
    Tag.FocalLength,
    Tag.DigitalZoomRatio,
)
"""The tags that tell cameras apart."""
_RESOLUTION = (
    Tag.FocalPlaneXResolution,
    Tag.FocalPlaneYResolution,
    Tag.FocalPlaneResolutionUnit,
)
_FOCAL = (Tag.FocalLength, Tag.FocalLengthIn35mmFilm)
_LENS = (*_FOCAL, *_RESOLUTION)


class ExifCamera(NamedTuple):
    """The tags from which a focal length can be found."""

    camera: Mapping[int, object]
    """Maker and model."""
    lens: Mapping[int, object]
    """The believed tags of the lens and of the sensor; empty if one of them cannot be."""
    doubt: str | None = None
    """The tag that is not believed and why, in words; None if all are."""
    whole: bool = True
    """Whether no tag of the lens and of the sensor was left out."""

    def exif(self) -> Image.Exif:
        """The tags as EXIF data."""
        made = Image.Exif()
        made.update(self.camera)
        made.get_ifd(ExifTags.IFD.Exif).update(self.lens)
        return made


def taken_with(tags: Mapping[int, object]) -> str:
    """What EXIF says of the camera (`jaxsfm.io.images.ImageFile.taken_with`)."""
    if not tags.get(Tag.Model):
        return ""
    values = (tags.get(tag, "") for tag in _IDENTITY)
    return ", ".join(text for value in values if (text := str(value).strip("\0 ")))


def exif_camera(tags: Mapping[int, object], size: tuple[int, int]) -> ExifCamera:
    """The tags of a camera, without those that cannot be.

    Tags are asked in COLMAP's order, up to the one that gives the focal length: the equivalent on
    35 mm film, the focal length with the resolution of the sensor, and the focal length with the
    sensor of a known model. A program that writes one number about the lens that no lens has is not
    believed about the others. EXIF writes 0, or a fraction with the denominator 0, for what is not
    known; such a tag is as if it were not there.

    Args:
      tags: EXIF's main directory and its directory of the exposure, together.
      size: (width, height) of the photo, pixels.
    """
    written = {tag: tags[tag] for tag in _LENS if tag in tags}
    unknown = {tag for tag in _FOCAL if not number(written.get(tag))}
    lens: dict[int, object] = {k: value for k, value in written.items() if k not in unknown}
    camera: dict[int, object] = {tag: tags[tag] for tag in _CAMERA if tag in tags}
    believed, doubt = _believed(lens, tags, size)
    return ExifCamera(camera, believed, doubt, whole=believed == written)


def _believed(
    lens: Mapping[int, object], tags: Mapping[int, object], size: tuple[int, int]
) -> tuple[Mapping[int, object], str | None]:
    """The tags of the lens that are believed, and which one is not, in words."""
    film = number(lens.get(Tag.FocalLengthIn35mmFilm))
    if film is not None:
        if not SHORTEST <= film <= LONGEST:
            return {}, f"FocalLengthIn35mmFilm ({film:g} mm)"
        doubt = _of_crop(tags, size)
        return (lens, None) if doubt is None else ({}, doubt)
    focal = number(lens.get(Tag.FocalLength))
    if focal is None:
        return lens, None
    if not 0 < focal <= LARGEST_FILM * LONGEST:
        return {}, f"FocalLength ({focal:g} mm)"
    if Tag.FocalPlaneXResolution not in lens:
        return lens, None
    per_unit = number(lens[Tag.FocalPlaneXResolution])
    per_mm = _PER_MM.get(int(number(lens.get(Tag.FocalPlaneResolutionUnit)) or 0))
    without = {tag: value for tag, value in lens.items() if tag not in _RESOLUTION}
    if per_mm is None:  # COLMAP does not use it either
        return without, "FocalPlaneXResolution (without a unit)"
    of = _written_size(tags) or size
    if not per_unit or not is_of_a_lens(focal * per_unit * per_mm, of):
        shown = "no number" if per_unit is None else f"{per_unit:g}"
        return {}, f"FocalPlaneXResolution ({shown})"
    ratio = max(of) / max(size)
    if not 1 / EQUIVALENTS_DIFFER <= ratio <= EQUIVALENTS_DIFFER:
        return without, f"FocalPlaneXResolution (it is for {of[0]:g} x {of[1]:g} pixels)"
    return lens, None


def equivalent_mm(focal_px: float, size: tuple[float, float]) -> float:
    """The equivalent on 35 mm film of a focal length in pixels of a photo of this size."""
    return focal_px / math.hypot(*size) * FILM_MM


def is_of_a_lens(focal_px: float, size: tuple[float, float]) -> bool:
    """Whether a lens has a focal length, in pixels of a photo of this size."""
    return SHORTEST <= equivalent_mm(focal_px, size) <= LONGEST


def number(value: object) -> float | None:
    """A number of EXIF; None if it is none. A rational with a zero denominator is not finite."""
    try:
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return found if math.isfinite(found) else None


def _written_size(tags: Mapping[int, object]) -> tuple[float, float] | None:
    """(width, height) that EXIF gives; None if it gives none."""
    width, height = (number(tags.get(tag)) for tag in (Tag.ExifImageWidth, Tag.ExifImageHeight))
    return (width, height) if width and height and width > 0 and height > 0 else None


def _of_crop(tags: Mapping[int, object], size: tuple[int, int]) -> str | None:
    """Why an equivalent on 35 mm film is not that of the photo: EXIF has another shape for it.

    A photo that was cut to another shape shows a smaller part of the sensor. One that programs
    have turned or reduced as a whole keeps the shape, up to a turn.
    """
    written = _written_size(tags)
    if written is None:
        return None
    shapes = [max(each) / min(each) for each in (written, size)]
    # The largest part of one shape that has the other: how much its diagonal is shorter.
    wide, narrow = max(shapes), min(shapes)
    whole, cut = math.hypot(narrow, 1), math.hypot(narrow, narrow / wide)
    if shapes[0] > shapes[1]:  # the sides were cut off
        whole, cut = math.hypot(wide, 1), math.hypot(narrow, 1)
    if whole / cut <= EQUIVALENTS_DIFFER:
        return None
    return f"FocalLengthIn35mmFilm (it is for {written[0]:g} x {written[1]:g} pixels)"
