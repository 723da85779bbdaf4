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


AREA = "500000 5000000 300 1 2 a.jpg\n500200 5000200 340 1 2 b.jpg\n"
"""Two points without names, 200 m apart and with 40 m between their heights."""


@pytest.mark.parametrize(
    "other",
    [
        "500030.1234 5000040.56 312.5",
        "500030.1234 5000040.560 312.50",  # the same number
        "500030.12340001 5000040.56000001 312.50000001",
        "500030.123 5000040.6 312.5",  # fewer digits
        "500030.1235 5000040.56 312.5",  # no receiver tells a tenth of a millimetre
        "500030.1234 5000040.56 3.125e2",
    ],
)
@pytest.mark.parametrize("name", ["", " P1"])
def test_lines_that_differ_only_by_rounding_mean_one_point(table, name, other):
    at = "500030.1234 5000040.56 312.5"
    for first, second in ((at, other), (other, at)):
        lines = f"{first} 7 8 c.jpg{name}\n{second} 9 8 d.jpg{name}\n"
        found = table(f"WGS84 UTM 32N\n{AREA}{lines}")
        assert [len(point.seen) for point in found.points] == [1, 1, 2]
        point = found.points[2]
        assert point.photos == ["c.jpg", "d.jpg"]
        # The digits that one line leaves out are those of the other.
        assert point.position[:3] == pytest.approx((500030.1234, 5000040.56, 312.5), abs=1.1e-4)


@pytest.mark.parametrize(
    "other",
    [
        "500030.1235 5000040.56 312.6",  # as many digits
        "500030.12 5000040.57 312.5",
        "500030 5000041 312.5",  # half a metre is much of 200 m
        "500030.1234 5000040.56 312",  # and of 40 m
        "500030.1234 5000040.56 nan",
    ],
)
def test_lines_without_names_that_differ_by_more_are_two_points(table, other):
    text = f"WGS84 UTM 32N\n{AREA}500030.1234 5000040.56 312.5 7 8 c.jpg\n{other} 9 8 d.jpg\n"
    assert [len(point.seen) for point in table(text).points] == [1, 1, 1, 1]


def test_a_name_says_that_rounded_lines_mean_one_point(table):
    lines = "500030 5000041 3.12e2 7 8 c.jpg P1\n500030.12 5000040.56 312.5 9 8 d.jpg P1\n"
    point = table(f"WGS84 UTM 32N\n{AREA}{lines}").points[2]
    assert point.photos == ["c.jpg", "d.jpg"]
    assert point.position[:3] == (500030.12, 5000040.56, 312.5)


def test_two_marks_in_one_photo_are_two_points_however_near(table):
    text = f"WGS84 UTM 32N\n{AREA}500030.12 5000040.56 312.5 7 8 c.jpg\n"
    found = table(text + "500030.1234 5000040.56 312.5 9 8 c.jpg\n")
    assert [point.position.x for point in found.points[2:]] == [500030.12, 500030.1234]


def test_degrees_are_rounded_as_metres_are(table):
    area = "8.68 47.48 300 1 2 a.jpg\n8.69 47.49 340 1 2 b.jpg\n"
    same = "8.6898742 47.4899497 310.5 1 2 c.jpg\n8.689874 47.48995 310.5 1 2 d.jpg\n"
    other = "8.69 47.49 310.5 1 2 e.jpg\n"  # a kilometre may lie between them
    found = table(f"EPSG:4326\n{area}{same}{other}")
    assert [point.photos for point in found.points] == [
        *(["a.jpg"], ["b.jpg"], ["c.jpg", "d.jpg"], ["e.jpg"])
    ]


def test_a_name_in_columns_may_be_rounded_too(table):
    text = "point;x;y;z;deviation;image;px;py\nA;1,25;2;3;0,1;a;4;5\nA;1,254;2;3;0,1;b;6;7\n"
    (point,) = table(text).points
    assert point.position == Position(1.254, 2, 3, 0.1) and point.photos == ["a", "b"]


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
        ("WGS84 UTM 32N\n1.25 2 3 4 5 a P\n1.26 2 3 4 5 b P\n", "P has another position"),
        ("WGS84 UTM 32N\n1 2 3 4 5 a P\n1 2 nan 4 5 b P\n", "P has another position"),
        ("WGS84 UTM 32N\n1.5 2 3 4 5 a\n1.5 2 3 4 6 a\n", "1.5 2 3 is measured twice in a"),
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
