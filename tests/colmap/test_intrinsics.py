"""Intrinsics from K.txt or MODEL:..., refused before COLMAP sees what it does not check."""

import numpy as np
import pycolmap
import pytest

from jaxsfm.colmap.given_cameras import parse_intrinsics
from jaxsfm.colmap.intrinsics import check_fits
from jaxsfm.errors import UserError

K = "1000 0 511.5\n0 1010 383.5\n0 0 1\n"
MODELS = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID"})


@pytest.mark.parametrize("text", [K, K.replace("\n", " "), K.replace(" ", ", "), "1e3" + K[4:]])
def test_a_k_matrix_is_a_pinhole_half_a_pixel_further(tmp_path, text):
    path = tmp_path / "K with blank.txt"
    path.write_text(text)
    intrinsics = parse_intrinsics(str(path))
    assert (intrinsics.model, intrinsics.params) == ("PINHOLE", (1000, 1010, 512, 384))


def test_a_k_matrix_projects_as_its_camera_does(tmp_path):
    """K x in our pixels is COLMAP's projection minus the half pixel."""
    (tmp_path / "K.txt").write_text(K)
    camera = parse_intrinsics(str(tmp_path / "K.txt")).camera((1024, 768))
    point = np.asarray([0.2, -0.1, 1.7])
    ours = np.loadtxt(tmp_path / "K.txt") @ point
    np.testing.assert_allclose(camera.img_from_cam(point) - 0.5, ours[:2] / ours[2], rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "params"),
    [
        ("SIMPLE_PINHOLE:1280,512,384", (1280, 512, 384)),
        ("SIMPLE_PINHOLE: 1280.5, 512 ,384", (1280.5, 512, 384)),
        ("OPENCV:1000,1001,512,384,0.1,-0.02,1e-3,0", (1000, 1001, 512, 384, 0.1, -0.02, 1e-3, 0)),
    ],
)
def test_a_named_model_is_taken_as_colmap_means_it(text, params):
    intrinsics = parse_intrinsics(text)
    assert intrinsics.model == text.partition(":")[0] and intrinsics.params == params
    camera = intrinsics.camera((1024, 768))
    assert (camera.width, camera.height) == (1024, 768)
    assert camera.has_prior_focal_length and camera.verify_params()
    assert tuple(camera.params) == params


@pytest.mark.parametrize("model", MODELS)
def test_every_model_of_colmap_is_accepted_whole_or_refused(model):
    params = pycolmap.Camera.create_from_model_name(1, model, 1000.0, 1024, 768).params
    text = f"{model}:" + ",".join(str(p) for p in params)
    try:
        intrinsics = parse_intrinsics(text)
        check_fits(intrinsics, {"a.jpg": (1024, 768)})
    except UserError as error:
        assert model == "EQUIRECTANGULAR", error
    else:
        assert intrinsics.params == tuple(params)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("SIMPLE_PINHOLE:1280,512", "expected 3 numbers .*; got 2"),
        ("SIMPLE_PINHOLE:1280,512,384,0", "expected 3 numbers .*; got 4"),
        ("SIMPLE_PINHOLE:", "SIMPLE_PINHOLE"),
        ("SIMPLE_PINHOLE:-1280,512,384", "focal length must be positive; got -1280"),
        ("PINHOLE:1280,0,512,384", "focal length must be positive; got 0"),
        ("OPENCV:1,1,512,384,0,0,nan,0", "must be finite"),
        ("SIMPLE_PINHOLE:inf,512,384", "must be finite"),
        ("SIMPLE_PINHOLE:1e999,512,384", "must be finite"),
        ("SIMPLE_PINHOLE:f,cx,cy", "could not convert"),
        ("PINHOLES:1,2,3", "unknown camera model 'PINHOLES'; one of .*SIMPLE_RADIAL"),
        ("INVALID:1,2,3", "unknown camera model 'INVALID'"),
        ("no/such/K.txt", "no/such/K.txt: no such file"),
        ("", "no such file"),
    ],
)
def test_a_bad_description_is_refused_naming_the_option(text, message):
    with pytest.raises(UserError, match=f"--intrinsics.*{message}"):
        parse_intrinsics(text)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "9 numbers of a 3 x 3 matrix; got 0"),
        (b"1000 0 512 0 1000 384", "got 6"),
        (K.encode() + b" 1", "got 10"),
        (b"-1000 0 512 0 1000 384 0 0 1", "focal lengths must be positive; got -1000"),
        (b"1000 0 512 0 0 384 0 0 1", "focal lengths must be positive"),
        (b"nan 0 512 0 1000 384 0 0 1", "must be finite"),
        (b"1000 0 inf 0 1000 384 0 0 1", "must be finite"),
        (b"1000 2 512 0 1000 384 0 0 1", "skew must be 0; got 2"),
        (b"1000 0 512 0 1000 384 0 0 2", "not a camera matrix"),
        (b"1000 0 512 3 1000 384 0 0 1", "not a camera matrix"),
        (b"1000 0 0 0 1000 0 512 384 1", "not a camera matrix"),  # transposed
        (b"fx 0 cx 0 fy cy 0 0 1", "could not convert"),
        (b"\x89PNG\r\n\x1a\n\xff\x00", "cannot be read as text"),
    ],
)
def test_a_bad_k_file_is_refused_naming_it(tmp_path, content, message):
    path = tmp_path / "K.txt"
    path.write_bytes(content)
    with pytest.raises(UserError, match=message) as error:
        parse_intrinsics(str(path))
    assert f"--intrinsics {path}" in str(error.value)


def test_a_folder_is_not_a_k_file(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        parse_intrinsics(str(tmp_path))


# -- do they fit the images ------------------------------------------------------------------------

CAMERA = parse_intrinsics("SIMPLE_PINHOLE:1000,512,384")


def test_one_size_with_the_principal_point_inside_fits():
    check_fits(CAMERA, {"a.jpg": (1024, 768), "b.jpg": (1024, 768)})


def test_images_of_different_sizes_are_refused_with_the_sizes():
    sizes = {"a.jpg": (1024, 768), "b.jpg": (768, 1024), "c.jpg": (1024, 768)}
    with pytest.raises(UserError, match=r"differ in size: 1024 x 768: 2.*768 x 1024: 1.*b\.jpg"):
        check_fits(CAMERA, sizes)


def test_the_sizes_stay_on_one_line_whatever_the_names():
    with pytest.raises(UserError) as error:
        check_fits(CAMERA, {"new\nline.jpg": (1024, 768), "b.jpg": (768, 1024)})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("size", [(512, 768), (400, 300), (1024, 384)])
def test_a_principal_point_outside_is_refused(size):
    with pytest.raises(UserError, match=rf"\(512, 384\) lies outside the {size[0]} x {size[1]}"):
        check_fits(CAMERA, {"a.jpg": size})
