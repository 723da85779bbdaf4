"""Photos are padded to few shapes, by few pixels."""

import pytest

from jaxsfm.io.features import padded_size


@pytest.mark.parametrize("size", [(800, 533), (600, 800), (1536, 1024), (801, 449), (1600, 1200)])
def test_a_photo_gets_at_most_an_eighth_more_pixels(size):
    rows, columns = padded_size(size)
    assert rows >= size[1] and columns >= size[0]
    assert rows * columns <= 1.125 * size[0] * size[1]


def test_sizes_that_differ_by_less_than_32_pixels_can_share_a_program():
    assert padded_size((800, 533)) == padded_size((770, 544)) == (544, 800)


@pytest.mark.parametrize("side", [48, 96, 127])
def test_the_fourth_octave_of_a_small_photo_has_a_coarse_cell(side):
    assert min(padded_size((side, side))) >> 3 >= 16
