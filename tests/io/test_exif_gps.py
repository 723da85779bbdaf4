"""The position in a photo's EXIF: what cameras write, and what some of them write wrongly."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, TiffImagePlugin

from jaxsfm.io.exif_gps import METRES_PER_DOP, gps_of, position_of
from jaxsfm.io.images import ImageFile, inspect_image

G = ExifTags.GPS
GOOD = {
    G.GPSLatitudeRef: "N",
    G.GPSLatitude: (46.0, 50.0, 33.3855),
    G.GPSLongitudeRef: "W",
    G.GPSLongitude: (91.0, 59.0, 40.4156),
    G.GPSAltitudeRef: b"\x00",
    G.GPSAltitude: 198.309,
}
ZERO = TiffImagePlugin.IFDRational(1, 0)


def photo(path: Path, fields: dict) -> Path:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(fields)
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(path, "JPEG", exif=exif)
    return path


def test_degrees_minutes_and_seconds_are_added_with_their_side(tmp_path):
    found = gps_of(inspect_image(photo(tmp_path / "a.jpg", GOOD)))
    assert found is not None
    assert found.y == pytest.approx(46 + 50 / 60 + 33.3855 / 3600, abs=1e-9)
    assert found.x == pytest.approx(-(91 + 59 / 60 + 40.4156 / 3600), abs=1e-9)
    assert found.z == pytest.approx(198.309) and found.deviation is None


def test_a_photo_of_the_real_flight_has_its_place(data_folder):
    path = data_folder / "brighton_gps" / "DJI_0018.JPG"
    found = gps_of(inspect_image(path))
    assert found is not None and found.z == 198.309
    assert (found.y, found.x) == pytest.approx((46.842607, -91.994560), abs=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        {G.GPSLatitudeRef: None},  # on which side of the equator?
        {G.GPSLongitudeRef: "?"},
        {G.GPSLatitude: (46.0, 50.0, ZERO)},
        {G.GPSLatitude: (46.0, 50.0)},
        {G.GPSLatitude: (91.0, 0.0, 0.0)},
        {G.GPSLongitude: (180.0, 0.0, 1.0)},
        {G.GPSLongitude: (1.0, 61.0, 0.0)},
        {G.GPSLatitude: (0.0, 0.0, 0.0), G.GPSLongitude: (0.0, 0.0, 0.0)},  # no fix
        {G.GPSLatitude: None},
        {G.GPSLatitude: "46 50"},
    ],
)
def test_what_is_no_place_is_no_position(change):
    assert position_of(GOOD) is not None
    assert position_of(GOOD | change) is None


@pytest.mark.parametrize(
    ("reference", "altitude", "z"),
    [
        (b"\x01", 3.5, -3.5),  # below sea level
        (1, 3.5, -3.5),
        (b"\x03", 3.5, -3.5),  # below the ellipsoid (EXIF 3.0)
        (b"\x02", 3.5, 3.5),
        (b"", 3.5, 3.5),
        (b"\x00", ZERO, None),
        (b"\x00", None, None),
    ],
)
def test_the_altitude_has_the_sign_of_its_reference_or_is_missing(reference, altitude, z):
    found = position_of(GOOD | {G.GPSAltitudeRef: reference, G.GPSAltitude: altitude})
    assert found is not None and found.z == z


def test_the_error_is_the_cameras_own_or_follows_from_the_satellites():
    def deviation(**fields):
        found = position_of(GOOD | {G[name]: value for name, value in fields.items()})
        assert found is not None
        return found.deviation

    assert deviation(GPSHPositioningError=4.7, GPSDOP=1.2) == 4.7
    assert deviation(GPSDOP=1.2) == pytest.approx(1.2 * METRES_PER_DOP)
    assert deviation(GPSHPositioningError=ZERO) is None
    assert deviation(GPSDOP=0.0) is None


def test_damaged_or_missing_metadata_is_no_error(tmp_path):
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(tmp_path / "plain.jpg")
    assert gps_of(inspect_image(tmp_path / "plain.jpg")) is None
    whole = photo(tmp_path / "whole.jpg", GOOD).read_bytes()
    start = whole.index(b"Exif")
    for at in range(start, start + 200, 7):
        damaged = bytearray(whole)
        damaged[at : at + 4] = b"\xff\x7f\xff\x7f"
        path = tmp_path / "damaged.jpg"
        path.write_bytes(damaged)
        name, sha256 = path.name, hashlib.sha256(damaged).hexdigest()
        gps_of(ImageFile(name=name, path=path, size=(64, 64), sha256=sha256))  # no exception
