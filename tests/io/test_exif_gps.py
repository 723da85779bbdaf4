"""The position in a photo's EXIF: what cameras write, and what some of them write wrongly."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, TiffImagePlugin

from jaxsfm.io import exif_gps
from jaxsfm.io.exif_data import ExifData
from jaxsfm.io.exif_gps import METRES_PER_DOP, gps_of, position_of, read_gps
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
ZERO, NAN = TiffImagePlugin.IFDRational(1, 0), TiffImagePlugin.IFDRational(0, 0)


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


def told(tmp_path: Path, caplog, *each: dict) -> tuple[dict, list[str]]:
    """The positions of photos a.jpg, b.jpg, ... with these fields, and the sentences about them."""
    images = [
        inspect_image(photo(tmp_path / f"{name}.jpg", fields))
        for name, fields in zip("abcdefgh", each, strict=False)
    ]
    caplog.clear()
    return read_gps(images), [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({G.GPSLatitudeRef: "?"}, "GPSLatitudeRef (neither N nor S)"),
        ({G.GPSLatitudeRef: "E"}, "GPSLatitudeRef (neither N nor S)"),
        ({G.GPSLatitudeRef: None}, "GPSLatitudeRef (neither N nor S)"),
        ({G.GPSLongitudeRef: "N"}, "GPSLongitudeRef (neither E nor W)"),
        ({G.GPSLongitudeRef: ""}, "GPSLongitudeRef (neither E nor W)"),
        ({G.GPSLatitude: (46.0, 50.0, ZERO)}, "GPSLatitude (not three numbers)"),
        ({G.GPSLatitude: (NAN, 50.0, 0.0)}, "GPSLatitude (not three numbers)"),
        ({G.GPSLatitude: (46.0, 50.0)}, "GPSLatitude (not three numbers)"),
        ({G.GPSLatitude: (90.0, 0.0, 0.001)}, "GPSLatitude (beyond 90 degrees)"),
        ({G.GPSLongitude: (180.0, 0.0, 0.001)}, "GPSLongitude (beyond 180 degrees)"),
        ({G.GPSLongitude: (1.0, 60.5, 0.0)}, "GPSLongitude (more than 60 minutes"),
        ({G.GPSLatitude: (1.0, 0.0, 60.1)}, "GPSLatitude (more than 60 minutes"),
        (
            {G.GPSLatitude: (0.0, 0.0, 0.0), G.GPSLongitude: (0.0, 0.0, 0.0)},  # no fix
            "GPSLatitude and GPSLongitude (0, 0)",
        ),
    ],
)
def test_what_is_no_place_is_no_position_and_its_tag_is_named(tmp_path, caplog, change, said):
    assert position_of(GOOD) is not None
    assert position_of(GOOD | change) is None
    damaged = {tag: value for tag, value in (GOOD | change).items() if value is not None}
    found, (sentence,) = told(tmp_path, caplog, GOOD, damaged)
    assert list(found) == ["a.jpg"]  # it costs no other photo
    assert sentence.startswith(f"b.jpg: EXIF is not believed about {said}")
    assert sentence.endswith("so the position is not used")


@pytest.mark.parametrize(
    ("latitude", "said"),
    [
        ((float("nan"), 50.0, 0.0), "(not three numbers)"),
        ((46.0, float("inf"), 0.0), "(not three numbers)"),
        ("46 50", "(not three numbers)"),
        ((-46.0, 50.0, 0.0), "(negative"),
    ],
)
def test_what_pillow_reads_but_does_not_write_is_named_too(
    tmp_path, caplog, monkeypatch, latitude, said
):
    fields = GOOD | {G.GPSLatitude: latitude}
    monkeypatch.setattr(exif_gps, "exif_data", lambda _: ExifData({}, fields))
    found, (sentence,) = told(tmp_path, caplog, {})
    assert not found and f"GPSLatitude {said}" in sentence


def test_photos_with_the_same_fault_are_named_in_one_sentence(tmp_path, caplog):
    wrong = [GOOD | {G.GPSLatitude: (91.0 + k, 0.0, 0.0)} for k in range(6)]
    found, (sentence,) = told(tmp_path, caplog, *wrong)
    assert not found
    assert sentence.startswith("a.jpg, b.jpg, ") and "more: EXIF is not believed" in sentence


def test_photos_without_a_position_are_not_doubted(tmp_path, caplog):
    only_altitude = {G.GPSAltitude: ZERO, G.GPSAltitudeRef: b"\x00"}
    assert told(tmp_path, caplog, {}, only_altitude, {G.GPSLatitude: (1.0, 2.0, 3.0)}) == ({}, [])


@pytest.mark.parametrize(
    ("lat", "lon"), [((90.0, 0.0, 0.0), (180.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (9.0, 59.0, 59.999))]
)
def test_the_borders_of_what_can_be_are_believed(tmp_path, caplog, lat, lon):
    found, said = told(tmp_path, caplog, GOOD | {G.GPSLatitude: lat, G.GPSLongitude: lon})
    assert list(found) == ["a.jpg"] and not said


@pytest.mark.parametrize("altitude", [-501.0, 20_001.0, 4_294_967_295.0])
def test_an_altitude_that_cannot_be_leaves_the_position_without_one(tmp_path, caplog, altitude):
    reference = b"\x01" if altitude < 0 else b"\x00"
    high = GOOD | {G.GPSAltitudeRef: reference, G.GPSAltitude: abs(altitude)}
    found, (sentence,) = told(tmp_path, caplog, GOOD, high)
    assert found["b.jpg"] == found["a.jpg"]._replace(z=None) and found["a.jpg"].full
    assert sentence == (
        "b.jpg: EXIF is not believed about GPSAltitude (below -500 m or above 20,000 m), so the "
        "altitude is not used"
    )


@pytest.mark.parametrize("altitude", [-430.0, 19_900.0])
def test_altitudes_of_deep_shores_and_high_flights_are_believed(altitude):
    fields = {G.GPSAltitudeRef: int(altitude < 0), G.GPSAltitude: abs(altitude)}
    found = position_of(GOOD | fields)
    assert found is not None and found.z == altitude


def test_one_position_for_all_photos_says_nothing(tmp_path, caplog):
    found, (sentence,) = told(tmp_path, caplog, GOOD, {}, GOOD, GOOD)
    assert not found
    assert sentence == (
        "a.jpg, c.jpg, d.jpg: EXIF is not believed about GPSLatitude and GPSLongitude (all photos "
        "have the same), so the position is not used"
    )
    moved = GOOD | {G.GPSLatitude: (46.0, 50.0, 33.3856)}
    found, said = told(tmp_path, caplog, GOOD, GOOD, moved)
    assert list(found) == ["a.jpg", "b.jpg", "c.jpg"] and not said
    found, said = told(tmp_path, caplog, GOOD)
    assert list(found) == ["a.jpg"] and not said


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
