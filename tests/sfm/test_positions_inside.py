"""Positions inside an adjustment straighten a row of photos, and wrong ones are outvoted."""

import copy
import dataclasses

import numpy as np
import pytest
from long_rows import off, row
from strategies import rng_of

from jaxsfm.colmap.bundle_adjustment import adjusted, adjusted_onto
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.core.bundle_problem import Positions
from jaxsfm.io.position_tables import Position
from jaxsfm.sfm.georeference.coordinate_system import LOCAL
from jaxsfm.sfm.georeference.georeference import MeasuredPositions, move_models
from jaxsfm.sfm.georeference.inside import FARTHEST, Settings, noise_px

HOW = {"loss_px": 5.0, "refine_intrinsics": False}
SETTINGS = Settings(**HOW)
PHOTOS, NOISE_PX, GPS = 60, 0.5, 0.3


@pytest.fixture(scope="module")
def truth() -> Model:
    """A row of photos with few points and coarse keypoints."""
    return row(PHOTOS, per_photo=15, noise_px=NOISE_PX)


@pytest.fixture(scope="module")
def made(truth):
    """The row as an adjustment without positions has it."""
    return adjusted(truth, threads=1, **HOW).to_colmap()


def positions(truth: Model, *, noise=GPS, wrong=(), seed=1) -> MeasuredPositions:
    rng = rng_of(seed)
    given = {view.name: view.centre + noise * rng.normal(size=3) for view in truth.views}
    for name in wrong:
        given[name] += [0.0, 9.0, 0.0]
    known = {name: Position(*xyz.tolist(), None) for name, xyz in given.items()}
    return MeasuredPositions(
        source="positions", file=None, system=LOCAL, positions=known, sure=False
    )


def moved(made, measured, settings=SETTINGS):
    """The model after the move, and its figures."""
    model = copy.deepcopy(made)
    found = move_models([model], measured, settings=settings).models[0]
    return Model.from_colmap(model, stored_sizes(model)), found


def worst(model: Model, truth: Model) -> float:
    centres = (np.stack([view.centre for view in each.views]) for each in (model, truth))
    return float(np.linalg.norm(np.subtract(*centres), axis=1).max())


def test_the_noise_of_keypoints_is_found(made):
    model = Model.from_colmap(made, stored_sizes(made))
    assert noise_px(model, 5.0, False) == pytest.approx(NOISE_PX, rel=0.05)


def test_a_row_is_straighter_with_positions_inside_and_wrong_ones_are_named(truth, made):
    wrong = ["007.png", "030.png", "052.png"]
    measured = positions(truth, wrong=wrong)
    rigid, before = moved(made, measured, None)
    unbent, after = moved(made, measured)
    assert before.inside is None and after.inside.kept
    assert worst(unbent, truth) < 0.7 * worst(rigid, truth)  # 0.20 and 0.39
    assert after.outliers == wrong
    assert after.held_out.total < after.inside.moved_only.total
    assert after.inside.deviation == pytest.approx(GPS, rel=0.7)
    rows = {row.name: row for row in after.anchors}
    for view in unbent.views:
        at = np.asarray(measured.positions[view.name][:3])
        np.testing.assert_allclose(rows[view.name].residual, view.centre - at, atol=1e-9)


def test_positions_that_are_much_worse_than_the_model_hardly_bend_it(truth, made):
    measured = positions(truth, noise=30.0, seed=2)
    unbent, after = moved(made, measured)
    assert off(unbent, truth) < 1.5 * off(Model.from_colmap(made, stored_sizes(made)), truth)
    assert after.inside is not None


def test_few_positions_only_move_the_model(truth, made):
    measured = positions(truth)
    few = dict(list(measured.positions.items())[:9])
    _, after = moved(made, dataclasses.replace(measured, positions=few))
    assert after.inside is None and after.residual is not None


def test_an_adjustment_does_not_end_because_its_steps_are_damped():
    """The noise of keypoints bends a long row gently. Positions see it, but a damped step promises
    to lower the cost by less than the tolerance: 1.56 off where 0.63 is right."""
    gps, straight = 2.0, row(400)
    measured = positions(straight, noise=gps)
    start, _ = moved(adjusted(straight, threads=1, **HOW).to_colmap(), measured, None)
    xyz = np.stack([np.asarray(measured.positions[view.name][:3]) for view in straight.views])
    weight, scale = np.full(400, (0.1 / gps) ** 2), np.float64(0.1 * FARTHEST)
    given = Positions(xyz, weight, scale)  # pyright: ignore
    ends = [adjusted_onto(each, given, **HOW) for each in (start, straight)]
    assert worst(ends[0], straight) < 1.2 * worst(ends[1], straight)
