"""Which photos share a camera, and with which camera the mapping starts."""

import io
import math
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from moving_views import HEIGHT, WIDTH, views
from PIL import ExifTags, Image

from jaxsfm.colmap.cameras import GUESSED_FOCAL, Cameras, estimated_camera
from jaxsfm.colmap.database import read_images, write_database
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.errors import UserError
from jaxsfm.io import orientation
from jaxsfm.io.images import ImageFile, inspect_image

SIZE = (96, 64)
PHONE = {0x010F: "Apple", 0x0110: "iPhone 4S"}
"""Make and model of a camera that COLMAP knows the sensor of."""
FOCAL_35 = 50
Base = ExifTags.Base


def photo(path: Path, exif: dict | None = None, size=SIZE, **lens) -> ImageFile:
    """A photo with EXIF; `lens` are tags of the camera's settings."""
    path.parent.mkdir(parents=True, exist_ok=True)
    written = Image.Exif()
    for tag, value in (exif or {}).items():
        written[tag] = value
    settings = {"focal": 0x920A, "focal35": 0xA405, "model": 0xA434, "serial": 0xA431}
    for name, value in lens.items():
        written.get_ifd(0x8769)[settings[name]] = value
    Image.new("RGB", size).save(path, exif=written)
    return inspect_image(path, name=path.name if path.parent.name != "sub" else f"sub/{path.name}")


def shared(images: list[ImageFile], **choice) -> list[list[str]]:
    return [[image.name for image in group] for _, group in Cameras(**choice).assigned(images)]


@pytest.fixture
def four(tmp_path) -> list[ImageFile]:
    """Photos of one size without EXIF, one of them in a sub-folder."""
    return [photo(tmp_path / name) for name in ("a.jpg", "b.jpg", "c.jpg", "sub/d.jpg")]


def test_each_way_of_sharing(four):
    assert shared(four, sharing="single") == [["a.jpg", "b.jpg", "c.jpg", "sub/d.jpg"]]
    assert shared(four, sharing="folder") == [["a.jpg", "b.jpg", "c.jpg"], ["sub/d.jpg"]]
    assert shared(four, sharing="photo") == [["a.jpg"], ["b.jpg"], ["c.jpg"], ["sub/d.jpg"]]
    assert shared(four, sharing="auto") == shared(four, sharing="single")


def test_photos_in_any_order_share_the_same_cameras(four):
    for sharing in ("single", "folder", "photo", "auto"):
        assert shared(four[::-1], sharing=sharing) == shared(four, sharing=sharing)


@pytest.mark.parametrize(
    "other",
    [
        dict(exif={**PHONE, 0x0110: "iPhone 5"}, focal=4.3),
        dict(exif={**PHONE, 0x010F: "Other"}, focal=4.3),
        dict(exif=PHONE, focal=5.0),
        dict(exif=PHONE, focal=4.3, model="tele"),
        dict(exif=PHONE, focal=4.3, serial="2"),
        dict(exif=PHONE, focal=4.3, size=(64, 96)),
        dict(),
    ],
    ids=["model", "make", "focal length", "lens", "body", "size", "no EXIF"],
)
def test_auto_separates_what_exif_tells_apart(tmp_path, other):
    """A photo without EXIF among photos that have it may be of any camera."""
    same = [photo(tmp_path / f"{name}.jpg", PHONE, focal=4.3) for name in "ab"]
    last = photo(tmp_path / "c.jpg", other.pop("exif", None), **other)
    assert shared([*same, last]) == [["a.jpg", "b.jpg"], ["c.jpg"]]


def test_photos_without_exif_and_of_several_sizes_have_cameras_of_their_own(tmp_path, four):
    cameras = shared([*four, photo(tmp_path / "e.jpg", size=(100, 64))])
    assert cameras == [["a.jpg"], ["b.jpg"], ["c.jpg"], ["e.jpg"], ["sub/d.jpg"]]


def test_turned_photos_without_exif_share_a_camera_of_their_own(tmp_path, four):
    cameras = shared([*four, photo(tmp_path / "e.jpg", size=SIZE[::-1])])
    assert cameras == [["a.jpg", "b.jpg", "c.jpg", "sub/d.jpg"], ["e.jpg"]]


def test_a_shared_camera_takes_its_focal_length_from_any_of_its_photos(tmp_path):
    """Some programs keep the name of the camera and lose the rest."""
    exif = {0x0110: "Nobody knows this one"}
    images = [photo(tmp_path / "a.jpg", exif), photo(tmp_path / "b.jpg", exif, focal35=50)]
    ((camera, _),) = Cameras().assigned(images)
    assert camera.has_prior_focal_length and camera.mean_focal_length() == pytest.approx(
        50 / np.hypot(36, 24) * np.hypot(*SIZE), rel=1e-3
    )


def test_without_exif_the_focal_length_is_a_guess(four):
    ((camera, _),) = Cameras().assigned(four)
    assert not camera.has_prior_focal_length
    assert camera.mean_focal_length() == GUESSED_FOCAL * max(SIZE)
    assert (camera.principal_point_x, camera.principal_point_y) == (SIZE[0] / 2, SIZE[1] / 2)


@pytest.mark.parametrize("model", ["OPENCV", "SIMPLE_RADIAL_FISHEYE", "PINHOLE"])
def test_the_model_is_the_chosen_one(four, model):
    ((camera, _),) = Cameras(model=model).assigned(four)
    assert camera.model_name == model and camera.verify_params()


def test_an_unknown_model_is_refused():
    with pytest.raises(ValueError, match="model must be one of .*OPENCV.*; got 'LENS'"):
        Cameras(model="LENS")


def test_a_single_camera_has_one_size(tmp_path, four):
    other = photo(tmp_path / "e.jpg", size=(64, 96))
    with pytest.raises(UserError, match=r"--cameras single: there is one camera, but .*e\.jpg"):
        Cameras(sharing="single").check_fits([*four, other])
    Cameras(sharing="auto").check_fits([*four, other])


def test_the_database_has_the_shared_cameras(tmp_path, four):
    write_database(tmp_path / "database.db", four, {}, Cameras(sharing="folder"))
    found = {
        name: camera.camera_id
        for name, (_, camera) in read_images(tmp_path / "database.db").items()
    }
    assert found["a.jpg"] == found["b.jpg"] == found["c.jpg"] != found["sub/d.jpg"]


TANGENTIAL = Intrinsics(model="OPENCV", params=(90.0, 80.0, 40.0, 30.0, 0.1, -0.02, 0.01, -0.03))


@pytest.mark.parametrize("code", [6, 8])
@pytest.mark.parametrize(
    "known",
    [TANGENTIAL, Intrinsics(model="SIMPLE_RADIAL", params=(90.0, 40.0, 30.0, 0.1))],
    ids=lambda known: known.model,
)
def test_a_camera_turns_with_the_pixels(tmp_path, code, known):
    """A point lies at the same place of the picture, however the picture is stored."""
    image = photo(tmp_path / "a.jpg", {0x0112: code}, size=SIZE[::-1])
    ((camera, _),) = Cameras(known=known).assigned([image])
    upright = known.camera(SIZE)
    assert image.upright_size == SIZE and (camera.width, camera.height) == image.size
    matrix = orientation.to_stored(image.size, code)
    for ray in np.random.default_rng(0).uniform(-0.4, 0.4, (20, 2)):
        turned = matrix[:2, :2] @ ray
        expected = matrix @ [*(upright.img_from_cam([*ray, 1.0]) - 0.5), 1.0]
        found = camera.img_from_cam([*turned, 1.0]) - 0.5
        np.testing.assert_allclose(found, expected[:2], atol=1e-9)


@pytest.mark.parametrize("code", [1, 3, 6])
def test_a_known_camera_is_that_of_the_stored_pixels(tmp_path, code):
    """A phone stores the rows of its sensor, however it is held."""
    image = photo(tmp_path / "a.jpg", {0x0112: code})
    ((camera, _),) = Cameras(known=TANGENTIAL).assigned([image])
    assert tuple(camera.params) == TANGENTIAL.params


def test_where_pixels_were_turned_the_camera_is_that_of_the_upright_photos(tmp_path):
    """A photo that was turned by 180 degrees has the size of the others."""
    images = [
        photo(tmp_path / "a.jpg"),
        photo(tmp_path / "b.jpg", {0x0112: 6}, size=SIZE[::-1]),
        photo(tmp_path / "c.jpg", {0x0112: 3}),
    ]
    assert shared(images, known=TANGENTIAL) == [["a.jpg"], ["b.jpg"], ["c.jpg"]]
    assert shared(images) == [["a.jpg"], ["b.jpg"], ["c.jpg"]]
    cameras = [camera for camera, _ in Cameras(known=TANGENTIAL).assigned(images)]
    assert tuple(cameras[2].params) == TANGENTIAL.turned(SIZE, 3).params != TANGENTIAL.params


def test_turned_photos_fit_the_camera_of_the_others(tmp_path):
    images = [
        photo(tmp_path / "a.jpg"),
        photo(tmp_path / "b.jpg", {0x0112: 6}, size=SIZE[::-1]),
        photo(tmp_path / "c.jpg", {0x0112: 6}, size=SIZE[::-1]),
    ]
    cameras = Cameras(known=TANGENTIAL)
    cameras.check_fits(images)
    assert shared(images, known=TANGENTIAL) == [["a.jpg"], ["b.jpg", "c.jpg"]]
    with pytest.raises(UserError, match="the images differ in size"):
        cameras.check_fits([*images, photo(tmp_path / "d.jpg", size=SIZE[::-1])])


def test_a_camera_that_cannot_be_turned_is_refused(tmp_path):
    known = Intrinsics(model="FOV", params=(90.0, 90.0, 48.0, 32.0, 0.5))
    image = photo(tmp_path / "a.jpg", {0x0112: 6}, size=SIZE[::-1])
    with pytest.raises(UserError, match="--intrinsics FOV: .*omega of this camera cannot be"):
        Cameras(known=known).assigned([image])


def test_every_model_of_colmap_is_turned_or_refused():
    for model in pycolmap.CameraModelId.__members__.keys() - {"INVALID", "EQUIRECTANGULAR"}:
        start = pycolmap.Camera.create_from_model_name(0, model, 80.0, *SIZE)
        known = Intrinsics(model=model, params=tuple(start.params))
        try:
            turned = known.turned(SIZE[::-1], 6)
        except UserError:
            continue
        assert turned.camera(SIZE[::-1]).verify_params()


def exif(orientation: int, focal: int | None) -> bytes:
    tags = Image.Exif()
    tags[Base.Make], tags[Base.Model], tags[Base.Orientation] = "Maker", "Model", orientation
    if focal is not None:
        tags.get_ifd(ExifTags.IFD.Exif)[Base.FocalLengthIn35mmFilm] = focal
    return tags.tobytes()


def written(path, focal, orientation=1):
    pillow_heif = pytest.importorskip("pillow_heif")
    picture = Image.fromarray(np.ascontiguousarray(views([0])[0]))
    if path.suffix == ".heic":
        file = io.BytesIO()
        pillow_heif.from_pillow(picture).save(file, exif=exif(orientation, focal))
        path.write_bytes(file.getvalue())
    elif path.suffix == ".dng":
        pytest.importorskip("rawpy")
        from raw_files import dng

        path.write_bytes(dng(np.asarray(picture), orientation=orientation, focal35=focal or 0))
    else:
        picture.save(path, exif=exif(orientation, focal))
    return inspect_image(path)


@pytest.mark.parametrize("suffix", [".jpg", ".heic", ".dng"])
def test_the_focal_length_comes_from_exif_in_any_format(tmp_path, suffix):
    camera = estimated_camera([written(tmp_path / f"a{suffix}", FOCAL_35)])
    # 35 mm film has a diagonal of 43.27 mm.
    expected = FOCAL_35 / 43.27 * math.hypot(WIDTH, HEIGHT)
    assert camera.mean_focal_length() == pytest.approx(expected, rel=1e-3)
    assert camera.has_prior_focal_length


@pytest.mark.parametrize("suffix", [".jpg", ".heic", ".dng"])
def test_without_exif_the_focal_length_of_a_stand_in_is_a_guess(tmp_path, suffix):
    camera = estimated_camera([written(tmp_path / f"a{suffix}", None)])
    assert camera.mean_focal_length() == pytest.approx(1.2 * WIDTH)
    assert not camera.has_prior_focal_length


@pytest.mark.parametrize("suffix", [".heic", ".dng"])
def test_a_sideways_photo_has_the_camera_of_its_upright_pixels(tmp_path, suffix):
    camera = estimated_camera([written(tmp_path / f"a{suffix}", FOCAL_35, orientation=6)])
    assert (camera.width, camera.height) == (HEIGHT, WIDTH)
    assert camera.has_prior_focal_length
