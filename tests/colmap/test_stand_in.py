"""The cameras of photos whose formats COLMAP does not read."""

import io
import math

import numpy as np
import pytest
from moving_views import HEIGHT, WIDTH, views
from PIL import ExifTags, Image

from jaxsfm.colmap.cameras import estimated_camera
from jaxsfm.io.images import inspect_image

FOCAL_35 = 50
Base = ExifTags.Base


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
def test_without_exif_the_focal_length_is_a_guess(tmp_path, suffix):
    camera = estimated_camera([written(tmp_path / f"a{suffix}", None)])
    assert camera.mean_focal_length() == pytest.approx(1.2 * WIDTH)
    assert not camera.has_prior_focal_length


@pytest.mark.parametrize("suffix", [".heic", ".dng"])
def test_a_sideways_photo_has_the_camera_of_its_upright_pixels(tmp_path, suffix):
    camera = estimated_camera([written(tmp_path / f"a{suffix}", FOCAL_35, orientation=6)])
    assert (camera.width, camera.height) == (HEIGHT, WIDTH)
    assert camera.has_prior_focal_length
