"""Laws of the size of low-resolution matching."""

import dataclasses
from pathlib import Path

import pytest

from jaxsfm.config import preset
from jaxsfm.io.images import ImageFile
from jaxsfm.runs.job import low_resolution

DEFAULT = preset("default")


def photos(*sides: int) -> list[ImageFile]:
    """Photos with these longer sides."""
    path = Path("a.png")
    return [ImageFile(name="a", path=path, size=(side, 100), sha256="") for side in sides]


@pytest.mark.parametrize(
    ("sides", "size"),
    [
        ([4000], 800),
        ([1000], 800),
        ([999], 560),
        ([640], 480),
        ([600], 480),
        ([599], None),  # reduced by less than a fifth
        ([200], None),
        ([640, 640, 4000], 480),
        ([640, 4000, 4000], 800),
        ([], None),
    ],
)
def test_the_median_photo_is_reduced_or_there_is_no_low_resolution(sides, size):
    found = low_resolution(DEFAULT, photos(*sides))
    assert (found and found.max_size) == size


def test_a_size_that_was_asked_for_is_taken():
    asked = dataclasses.replace(DEFAULT, low_resolution=300, low_resolution_share=1.0)
    found = low_resolution(asked, photos(640))
    assert found is not None and found.max_size == 300
    assert low_resolution(dataclasses.replace(asked, low_resolution=600), photos(640)) is None


def test_robust_describes_photos_at_full_size():
    assert low_resolution(preset("robust"), photos(4000)) is None
