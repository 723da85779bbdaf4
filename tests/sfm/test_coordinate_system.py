"""Coordinate systems by their names, and the frames of models in them."""

import sys

import numpy as np
import pytest

from jaxsfm.errors import UserError
from jaxsfm.sfm.georeference.coordinate_system import GPS, coordinate_system

PLACE = np.asarray([[9.0, 48.0, 300.0], [9.001, 48.001, 310.0], [9.002, 48.0, 305.0]])
"""Longitude, latitude, height."""


def test_the_origin_of_a_gps_frame_lies_amid_the_positions():
    frame = GPS.frame(PLACE)
    assert frame.origin == (48.0, 9.001, 305.0) and frame.offset == (0, 0, 0)
    found = GPS.into(frame, PLACE)
    assert found[0, 0] < 0 < found[2, 0] and found[1, 1] > 100
    assert found[1, 2] == pytest.approx(5, abs=0.01)


@pytest.mark.parametrize(
    "text", ["EPSG:4326", "epsg:4979", "WGS84", "+proj=longlat +datum=WGS84 +no_defs"]
)
def test_longitude_and_latitude_need_no_other_package(text, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert coordinate_system(text, "here").kind == "geographic"
    with pytest.raises(UserError, match=r"needs pyproj: pip install 'jaxsfm\[geo\]'"):
        coordinate_system("EPSG:32632", "here")


@pytest.mark.parametrize(
    "text", ["WGS84 UTM 32N", "EPSG:32632", "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs"]
)
def test_utm_by_any_name_is_easting_and_northing(text):
    pyproj = pytest.importorskip("pyproj")
    to = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32632", always_xy=True)
    utm = np.stack(to.transform(*PLACE.T), axis=1)
    system = coordinate_system(text, "here")
    frame = system.frame(utm)
    assert system.kind == "projected" and frame.axes == "easting, northing, height"
    np.testing.assert_allclose(system.into(frame, utm) + np.asarray(frame.offset), utm)
    assert frame.origin == pytest.approx((48.0, 9.001, 305.0), abs=2e-5)


def test_the_southern_half_has_zones_of_its_own():
    pytest.importorskip("pyproj")
    crs = coordinate_system("WGS84 UTM 56S", "here").crs
    assert crs is not None and crs.to_epsg() == 32756


def test_another_datum_is_brought_to_wgs84():
    pytest.importorskip("pyproj")
    system = coordinate_system("EPSG:4314", "here")  # DHDN, some 100 m away
    frame = system.frame(PLACE)
    assert system.kind == "geographic" and frame.origin is not None
    lat, lon, _ = frame.origin
    assert 1e-4 < abs(lon - 9.001) + abs(lat - 48.0) < 1e-2


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("EPSG:999999", "no known coordinate system"),
        ("WGS84 UTM 99N", "no known coordinate system"),
        ("+proj=nonsense", "no known coordinate system"),
        ("EPSG:4978", "EPSG:4978 is not a projection"),
    ],
)
def test_what_is_no_projection_is_refused(text, says):
    pytest.importorskip("pyproj")
    with pytest.raises(UserError, match=says):
        coordinate_system(text, "--georeference gcp_list.txt")


def test_survey_feet_are_converted_to_metres():
    pytest.importorskip("pyproj")
    system = coordinate_system("EPSG:2263", "--georeference gcp_list.txt")
    feet = np.asarray([[984_250.0, 196_850.0, 0.0], [985_250.0, 196_850.0, 300.0]])
    one, two = system.into(system.frame(feet), feet)
    foot = 1200 / 3937  # the definition of the US survey foot
    np.testing.assert_allclose(two - one, [1000 * foot, 0, 300 * foot], atol=1e-6)
