"""Lists of known cameras: what a line says, whose camera it is, and what is refused."""

from pathlib import Path

import pytest

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.given_cameras import (
    listed_name,
    parse_cameras,
    parse_intrinsics,
    read_camera_list,
    write_camera_list,
)
from jaxsfm.colmap.intrinsics import Intrinsics, check_fits, used_cameras
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile

CAMERA = Intrinsics(model="SIMPLE_PINHOLE", params=(500.0, 320.0, 240.0))
FIRST = "day/a.jpg SIMPLE_PINHOLE 640 480 500 320 240"
LAST = "night/a b.jpg OPENCV 800 600 700 701 400 300 0.1 -0.02 1e-3 0"


def written(tmp_path, *lines: str) -> Path:
    path = tmp_path / "cameras.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_list_says_the_camera_and_the_size_of_each_photo(tmp_path):
    path = written(tmp_path, "# NAME MODEL WIDTH HEIGHT PARAMETERS", "", FIRST, f"  {LAST} ", FIRST)
    found = parse_cameras(str(path))
    assert found == {
        "day/a.jpg": Intrinsics(
            model="SIMPLE_PINHOLE", params=(500.0, 320.0, 240.0), size=(640, 480)
        ),
        "night/a b.jpg": Intrinsics(
            model="OPENCV", params=(700, 701, 400, 300, 0.1, -0.02, 1e-3, 0), size=(800, 600)
        ),
    }
    assert found == read_camera_list(path, "--root")
    again = tmp_path / "again.txt"
    write_camera_list(again, found)
    assert parse_cameras(str(again)) == found


@pytest.mark.parametrize("text", ["K.txt", "SIMPLE_PINHOLE:500,320,240"])
def test_one_camera_of_all_photos_is_read_as_before(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    Path("K.txt").write_text("\ufeff500 0 319.5\n0 500 239.5\n0 0 1\n", encoding="utf-8")
    assert parse_cameras(text) == parse_intrinsics(text)


def test_what_rounding_leaves_in_a_matrix_is_no_skew(tmp_path):
    path = tmp_path / "K.txt"

    def read(skew: str, last: str = "0 0 1"):
        path.write_text(f"500 {skew} 319.5\n0 500 239.5\n{last}\n")
        return parse_intrinsics(str(path))

    assert read("-7e-05") == read("0") == read("0", "1e-9 0 1.00000001")
    for skew, last in (("0.002", "0 0 1"), ("0", "0 1e-5 1"), ("0", "0 0 2")):
        with pytest.raises(UserError, match=r"skew|not a camera matrix"):
            read(skew, last)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([FIRST, "b.jpg SIMPLE_PINHOLE 640 480 500 320"], "line 2 is not NAME MODEL WIDTH HEIGHT"),
        ([FIRST, "b.jpg LENS 640 480 500 320 240"], "line 2 is not NAME MODEL"),
        ([FIRST, "SIMPLE_PINHOLE 640 480 500 320 240"], "line 2 is not NAME MODEL"),
        (
            [FIRST, "b.jpg SIMPLE_PINHOLE 640.5 480 500 320 240"],
            "whole numbers of pixels; got 640.5",
        ),
        (
            [FIRST, "b.jpg SIMPLE_PINHOLE 640 1e999 500 320 240"],
            "whole numbers of pixels; got 1e999",
        ),
        (
            [FIRST, "b.jpg SIMPLE_PINHOLE 640 4.8.0 500 320 240"],
            "whole numbers of pixels; got 4.8.0",
        ),
        ([FIRST, "b.jpg SIMPLE_PINHOLE 0 480 500 320 240"], "whole numbers of pixels; got 0"),
        ([FIRST, "b.jpg SIMPLE_PINHOLE -640 480 500 320 240"], "whole numbers of pixels; got -640"),
        ([FIRST, "b.jpg SIMPLE_PINHOLE 640 480 -500 320 240"], "line 2 is not NAME MODEL"),
        ([LAST, FIRST, FIRST.replace("500", "501")], "line 3 is a second camera of day/a.jpg"),
        (["# nothing"], "neither a 3 x 3 matrix nor a list of cameras"),
        ([""], "neither a 3 x 3 matrix nor a list of cameras"),
    ],
)
def test_a_damaged_list_is_refused_naming_file_and_line(tmp_path, lines, message):
    path = written(tmp_path, *lines)
    with pytest.raises(UserError) as raised:
        parse_cameras(str(path))
    assert str(raised.value).startswith(f"--intrinsics {path}")
    assert message in str(raised.value) and "\n" not in str(raised.value)


def test_whole_sizes_may_be_written_with_decimals(tmp_path):
    text = FIRST.replace("640 480", "640.0 4.80e2")
    assert parse_cameras(str(written(tmp_path, text))) == parse_cameras(
        str(written(tmp_path, FIRST))
    )


@pytest.mark.parametrize("first", ["\ufeff", ""])
@pytest.mark.parametrize("name", ["1 (2).jpg", "2024,01.jpg", "a\tb.jpg", "SIMPLE_PINHOLE 7.jpg"])
def test_names_that_begin_as_a_matrix_does_or_have_blanks_are_those_of_a_list(
    tmp_path, name, first
):
    path = tmp_path / "cameras.txt"
    path.write_text(f"{first}{name} SIMPLE_PINHOLE 640 480 500 320 240\n", encoding="utf-8")
    assert list(parse_cameras(str(path))) == [name]


@pytest.mark.parametrize("name", ["#a.jpg", " a.jpg", "a.jpg "])
def test_a_name_that_a_list_cannot_hold_is_not_written(tmp_path, name):
    with pytest.raises(UserError, match=r"a\.jpg.*cannot hold this name"):
        write_camera_list(tmp_path / "list.txt", {name: CAMERA})
    assert not (tmp_path / "list.txt").exists()


def test_a_run_depends_on_the_cameras_of_its_own_photos_alone(tmp_path):
    images = [ImageFile(name="a.jpg", path=tmp_path / "a", size=(640, 480), sha256="a")]
    known = {"a.jpg": CAMERA, "b.jpg": CAMERA}
    assert used_cameras(known, images) == {"a.jpg": CAMERA}
    assert used_cameras(CAMERA, images) is CAMERA


def test_a_photo_that_is_not_on_the_list_or_has_another_size_is_named(tmp_path):
    known = parse_cameras(str(written(tmp_path, FIRST, LAST)))
    check_fits(known, {"day/a.jpg": (640, 480), "night/a b.jpg": (800, 600)})
    with pytest.raises(UserError, match=r"no camera of night/a\.jpg"):
        check_fits(known, {"night/a.jpg": (800, 600)})
    with pytest.raises(UserError, match=r"day/a\.jpg is for 640 x 480 pixels, .* has 640 x 481"):
        check_fits(known, {"day/a.jpg": (640, 481)})


def test_photos_with_equal_cameras_share_one(tmp_path):
    focal = {"a": 5, "b": 6, "c": 5}
    lines = [f"{name}.jpg SIMPLE_PINHOLE 640 480 {f} 320 240" for name, f in focal.items()]
    images = [
        ImageFile(name=f"{name}.jpg", path=tmp_path / name, size=(640, 480), sha256=name)
        for name in "abc"
    ]
    cameras = Cameras(known=parse_cameras(str(written(tmp_path, *lines))))
    shared = [
        (camera.params[0], [image.name for image in group])
        for camera, group in cameras.assigned(images)
    ]
    assert shared == [(5, ["a.jpg", "c.jpg"]), (6, ["b.jpg"])]


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("photos/night/a.jpg", "night/a.jpg"),
        ("a.jpg", "a.jpg"),
        ("other/a.jpg", "a.jpg"),
        ("/photos/day/a.jpg", "a.jpg"),
        ("night/b.jpg", None),
        ("/x/c.jpg", "/x/c.jpg"),
        ("y/x/c.jpg", None),
        ("night/aa.jpg", None),
    ],
)
def test_a_photo_has_the_longest_name_that_its_path_ends_with(path, name):
    known = dict.fromkeys(["a.jpg", "night/a.jpg", "x/night/b.jpg", "/x/c.jpg"], None)
    assert listed_name(Path(path), known) == name
