"""Which tags of EXIF about a lens are believed."""

import pytest
from PIL import ExifTags
from PIL.TiffImagePlugin import IFDRational

from jaxsfm.io.exif_camera import exif_camera

Tag = ExifTags.Base
SIZE = (6000, 4000)
OF_A_LENS = {Tag.Make: "maker", Tag.Model: "model", Tag.FocalLength: 50.0}
RESOLUTION = {Tag.FocalPlaneXResolution: 4242.0, Tag.FocalPlaneResolutionUnit: 2}


def doubt(tags: dict, size=SIZE) -> str | None:
    return exif_camera(OF_A_LENS | tags, size).doubt


@pytest.mark.parametrize("film", [5, 8, 50, 600, 2000])
def test_focal_lengths_that_lenses_have_are_believed(film):
    tags = OF_A_LENS | RESOLUTION | {Tag.FocalLengthIn35mmFilm: film}
    found = exif_camera(tags, SIZE)
    assert found.doubt is None and found.whole
    assert found.lens[Tag.FocalLengthIn35mmFilm] == film


@pytest.mark.parametrize("film", [1, 4.9, 2001, 65535])
def test_an_equivalent_that_no_lens_has_discredits_the_lens(film):
    found = exif_camera(OF_A_LENS | {Tag.FocalLengthIn35mmFilm: film}, SIZE)
    assert found.doubt is not None and "FocalLengthIn35mmFilm" in found.doubt
    assert not found.lens and found.camera[Tag.Model] == "model"


@pytest.mark.parametrize(
    ("tags", "word"),
    [
        ({Tag.FocalPlaneXResolution: 0.0, Tag.FocalPlaneResolutionUnit: 2}, "Resolution (0)"),
        ({Tag.FocalPlaneXResolution: 4242.0}, "without a unit"),
        ({Tag.FocalPlaneXResolution: 1e9, Tag.FocalPlaneResolutionUnit: 2}, "Resolution (1e+09)"),
        ({Tag.FocalLength: 1e6}, "FocalLength (1e+06 mm)"),
        (RESOLUTION | {Tag.ExifImageWidth: 600, Tag.ExifImageHeight: 400}, "FocalPlaneXResolution"),
        (
            {
                Tag.FocalLengthIn35mmFilm: 50,
                Tag.ExifImageWidth: 6000,
                Tag.ExifImageHeight: 1000,
            },
            "it is for 6000 x 1000 pixels",
        ),
    ],
)
def test_a_tag_that_cannot_be_is_named(tags, word):
    assert word in (doubt(tags) or "")


def test_what_is_not_known_is_no_contradiction():
    assert doubt({Tag.FocalLength: 0, Tag.FocalLengthIn35mmFilm: 0}) is None
    assert doubt({Tag.FocalLength: IFDRational(50, 0)}) is None


def test_a_photo_that_was_turned_or_reduced_as_a_whole_keeps_its_focal_length():
    tags = {Tag.FocalLengthIn35mmFilm: 50, Tag.ExifImageWidth: 6000, Tag.ExifImageHeight: 4000}
    for size in ((4000, 6000), (600, 400), (6000, 4010)):
        assert doubt(tags, size) is None
