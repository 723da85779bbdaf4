"""A model that rests on what stays at the same pixels is told from one of the scene."""

import dataclasses

import numpy as np
from room_run import NAMES, model_with
from room_scene import SIZE, Room
from verdicts import check_of

from jaxsfm.sfm.check.still_model import of_still_pixels, with_still_models
from jaxsfm.sfm.mapped_stage import VerificationFigures
from jaxsfm.sfm.refined_stage import Reconstructed


def still(share: float) -> np.ndarray:
    """Photos of the room whose left part stays, up to a column."""
    found = np.zeros(SIZE[::-1], bool)
    found[:, : round(share * SIZE[0])] = True
    return found


def on_pixels(model, still: np.ndarray) -> float:
    """The share of the observations on still pixels, point by point."""
    on = [
        still[int(point.xy[1]), int(point.xy[0])]
        for image in model.images.values()
        for point in image.points2D
        if point.has_point3D()
    ]
    return float(np.mean(on))


def test_most_observations_decide(rendered: Room):
    model = model_with(rendered, range(5))
    shares = [on_pixels(model, still(share)) for share in (0.2, 0.8)]
    assert shares[0] < 0.45 and shares[1] > 0.55
    assert not of_still_pixels(model, still(0.2))
    assert of_still_pixels(model, still(0.8))
    assert of_still_pixels(model, still(1.0)) and not of_still_pixels(model, still(0.0))


def test_photos_of_another_size_do_not_count(rendered: Room):
    model = model_with(rendered, range(5))
    assert not of_still_pixels(model, np.ones((SIZE[1] + 1, SIZE[0]), bool))


def test_each_model_is_told_by_itself_and_unchecked_ones_stay_so(rendered: Room):
    made = Reconstructed.nothing(VerificationFigures(verified={}, angles={}))
    model = model_with(rendered, range(5))
    made = dataclasses.replace(
        made,
        models=[model, model],
        mapping=dataclasses.replace(made.mapping, checks=[check_of("green"), None]),
    )
    told = with_still_models(made, still(1.0)).mapping.checks
    assert told[0] is not None and told[0].same_pixels and told[0].verdict == "amber"
    assert told[1] is None
    assert with_still_models(made, still(0.0)).mapping.checks == made.mapping.checks
    assert set(NAMES) == {image.name for image in model.images.values()}
