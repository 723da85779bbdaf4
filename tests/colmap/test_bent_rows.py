"""A long row of photos that is bent becomes straight in one adjustment."""

from long_rows import bent, off, row

from jaxsfm.colmap.bundle_adjustment import _by_colmap, adjusted
from jaxsfm.colmap.model import Model

HOW = {"loss_px": 1.0, "refine_intrinsics": False, "threads": 1}


def test_a_bent_row_becomes_straight_and_colmap_leaves_it_bent():
    truth = row(240)
    wrong = bent(truth, 30.0)
    assert off(wrong, truth) > 4.0
    assert off(adjusted(wrong, **HOW), truth) < 0.2
    by_colmap = wrong.to_colmap()
    _by_colmap(by_colmap, steps=50, **HOW)
    assert off(Model.from_colmap(by_colmap, truth.sizes), truth) > 2.0
