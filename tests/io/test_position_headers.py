"""Tables of positions as other tools write them."""

import pytest

from jaxsfm.io.position_tables import Measurement, Position, read_position_table

AT = Position(7.5, 46.25, 500.0)


@pytest.fixture
def table(tmp_path):
    def read(text: str):
        path = tmp_path / "table.txt"
        path.write_text(text)
        return read_position_table(path)

    return read


@pytest.mark.parametrize(
    "text",
    [
        "#Label,X/Longitude,Y/Latitude,Z/Altitude\na.jpg,7.5,46.25,500\n",
        "imagename,latitude [decimal degrees],longitude [decimal degrees],altitude [meter]\n"
        "a.jpg,46.25,7.5,500\n",
        "Image,Latitude,Longitude,Altitude\na.jpg,46.25,7.5,500\n",
        "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\na.jpg,46.25,7.5,500\n",
        "ALTITUDE;LONGITUDE;IMAGE;LATITUDE\n500;7.5;a.jpg;46.25\n",
    ],
)
def test_headers_of_other_tools_are_read(table, text):
    found = table(text)
    assert found.system == "EPSG:4326" and found.positions == {"a.jpg": AT}


def test_our_own_column_is_preferred_to_one_that_is_called_alike(table):
    text = "label,image,lon,lat,alt\nsomething,a.jpg,7.5,46.25,500\n"
    assert table(text).positions == {"a.jpg": AT}


@pytest.mark.parametrize("separator", ["\t", "  ", " \t"])
def test_names_of_photos_may_have_blanks(table, separator):
    name, fields = "2022-09-26 15-24-47 a.jpg", ("7.5", "46.25", "500")
    found = table("EPSG:4326\n" + separator.join([name, *fields]) + "\n")
    assert found.positions == {name: AT}
    row = separator.join(["500010.5", "5000020.25", "312.5", "100.5", "200", name, "P1"])
    (point,) = table("EPSG:32632\n" + row + "\n").points
    assert point.name == "P1" and point.seen == [Measurement(name, 100.5, 200, 2)]
