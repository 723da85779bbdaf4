"""Tables of positions: the two layouts, and one clear sentence for each kind of bad line."""

import pytest

from jaxsfm.errors import UserError
from jaxsfm.io.position_tables import Measurement, Position, read_position_table

GCP = """WGS84 UTM 32N
# a remark
500010.5 5000020.25 312.5 100.5 200 a.jpg P1 checked by hand
500010.5 5000020.25 312.5 10 20.75 b.jpg P1
500030 5000040 NaN 7 8 a.jpg
"""


@pytest.fixture
def table(tmp_path):
    def read(text: str):
        path = tmp_path / "table.txt"
        path.write_text(text)
        return read_position_table(path)

    return read


def test_opendronemaps_control_points_are_gathered_by_their_names(table):
    found = table(GCP)
    assert found.system == "WGS84 UTM 32N" and not found.positions
    first, second = found.points
    assert first.name == "P1" and first.position == Position(500010.5, 5000020.25, 312.5)
    assert first.seen == [Measurement("a.jpg", 100.5, 200, 3), Measurement("b.jpg", 10, 20.75, 4)]
    assert second.name == "500030 5000040 NaN" and second.position.z is None


def test_opendronemaps_camera_positions_have_their_accuracy_in_the_eighth_column(table):
    found = table("EPSG:4326\na.jpg -91.9942 46.8425 198.6 0 0 0 0.03 0.05\nb.jpg 7 45\n")
    assert found.system == "EPSG:4326" and not found.points
    assert found.positions["a.jpg"] == Position(-91.9942, 46.8425, 198.6, 0.03)
    assert found.positions["b.jpg"] == Position(7, 45, None)


def test_a_csv_file_of_places_has_longitude_as_x(table):
    found = table("image, lat, lon, alt, deviation\na.jpg, 46.5, -91.25, 198, 2.5\nb.jpg,1,2,,\n")
    assert found.system == "EPSG:4326"
    assert found.positions == {
        "a.jpg": Position(-91.25, 46.5, 198, 2.5),
        "b.jpg": Position(2, 1, None),
    }


def test_a_csv_file_of_metres_has_no_coordinate_system_unless_it_names_one(table):
    text = "point;x;y;z;image;px;py\nA;1;2;3;my photo.jpg;4;5\nA;1;2;3;b.jpg;6;7\n"
    assert table(text).system is None
    found = table("EPSG:32632\n" + text)
    assert found.system == "EPSG:32632" and found.points[0].position == Position(1, 2, 3)
    assert found.points[0].seen[0] == Measurement("my photo.jpg", 4, 5, 3)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "the file is empty"),
        ("EPSG:4326\n", "nothing below the coordinate system"),
        ("500010 5000020 3 1 2 a.jpg\n", "the first line must name a coordinate system"),
        ("image,px,py\na.jpg,1,2\n", "needs the columns lat, lon, alt or x, y, z"),
        ("point,x,y,z,image\nA,1,2,3,a.jpg\n", "control points need the columns px and py"),
        ("image,x,y,z\na.jpg,1,2\n", "line 2: must have 4 fields"),
        ("image,x,y,z\na.jpg,1,two,3\n", "line 2: y must be a number; got 'two'"),
        ("image,x,y,z\na.jpg,inf,2,3\n", "line 2: x must be finite"),
        ("image,x,y,z,deviation\na.jpg,1,2,3,-1\n", "deviation must be positive; got -1"),
        ("image,x,y,z\na.jpg,1,2,3\na.jpg,1,2,3\n", "line 3: a.jpg has a position already"),
        ("WGS84 UTM 32N\n1 2 3 4 5\n", "line 2: must be x y z px py image [name]; got 5 fields"),
        ("WGS84 UTM 32N\n1 2 3 4 5 a P\n9 2 3 4 5 b P\n", "P has another position"),
        ("WGS84 UTM 32N\n1 2 3 4 5 a P\n1 2 3 4 6 a P\n", "P is measured twice in a"),
        ("WGS84 UTM 32N\n1 2 3 4 5 a P\nb 2 3 4\n", "all begin with a number"),
        ("EPSG:4326\nb.jpg 2\n", "must be image x y"),
    ],
)
def test_a_bad_line_is_named(table, text, says):
    with pytest.raises(UserError) as error:
        table(text)
    assert says in str(error.value) and str(error.value).startswith("--georeference ")
    assert "\n" not in str(error.value)


def test_a_file_of_bytes_is_no_table(tmp_path):
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"\xff\xd8\xff\xe0\x00")
    with pytest.raises(UserError, match="cannot be read as text"):
        read_position_table(path)
