"""Models moved into metres: exact data, noise, wrong positions, and what determines no move."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from flights import Flight, flight
from scipy.spatial.transform import Rotation

from jaxsfm.colmap.poses import model_poses
from jaxsfm.io.position_tables import ControlPoint, Measurement, Position
from jaxsfm.sfm.evaluation import umeyama
from jaxsfm.sfm.georeference.coordinate_system import LOCAL
from jaxsfm.sfm.georeference.georeference import (
    MeasuredPositions,
    move_models,
    triangulated,
    views_by_name,
)
from jaxsfm.sfm.georeference.model_georeference import ModelGeoreference
from jaxsfm.sfm.georeference.robust_similarity import Anchors, robust_similarity

DRAWS = 50
HORIZONTAL, VERTICAL = 1.5, 3.0
"""Errors of GPS in the draws, metres."""
PIXEL, SURVEY = 0.5, 0.02
"""Errors of control points in the draws: pixels, and metres."""


def measured(centres, **changes) -> MeasuredPositions:
    rows = {name: Position(*map(float, at)) for name, at in centres.items()}
    made = MeasuredPositions(
        source="positions", file="table.csv", system=LOCAL, positions=rows, sure=False
    )
    return dataclasses.replace(made, **changes)


def moved(flown: Flight, given: MeasuredPositions) -> ModelGeoreference:
    (found,) = move_models([flown.model], given).models
    return found


def surveyed(flown: Flight, points: np.ndarray, rng=None) -> list[ControlPoint]:
    """Control points, exact or with errors."""
    made = []
    for k, point in enumerate(points):
        at, seen = point, flown.seen(point)
        if rng is not None:
            at = point + rng.normal(0, SURVEY, 3)
            seen = {name: xy + rng.normal(0, PIXEL, 2) for name, xy in seen.items()}
        rows = [Measurement(name, *xy.tolist(), 1) for name, xy in seen.items()]
        made.append(ControlPoint(name=f"P{k}", position=Position(*at.tolist()), seen=rows))
    return made


def ground(rng, n: int) -> np.ndarray:
    return rng.uniform([0, 0, -3], [100, 60, 3], (n, 3))


# -- exact data ----------------------------------------------------------------------------------


def test_exact_positions_bring_back_the_model_in_metres():
    flown = flight()
    found = moved(flown, measured(flown.centres))
    assert found.similarity is not None and found.similarity.scale == pytest.approx(20)
    poses, truth = model_poses(flown.model), model_poses(flown.truth)
    for name, pose in truth.items():
        np.testing.assert_allclose(poses[name].centre, pose.centre, atol=1e-9)
        np.testing.assert_allclose(poses[name].rotation, pose.rotation, atol=1e-9)
    assert found.residual is not None and found.residual.total < 1e-9
    assert found.held_out is not None and found.held_out.total < 1e-9
    assert found.outliers == []


def test_exact_control_points_bring_back_the_model_in_metres():
    flown, rng = flight(), np.random.default_rng(0)
    points = surveyed(flown, ground(rng, 6))
    found = moved(flown, measured({}, source="control points", points=points))
    move = flown.move_found()
    np.testing.assert_allclose(move.rotation, np.eye(3), atol=1e-7)
    np.testing.assert_allclose(move.translation, 0, atol=1e-5)
    assert move.scale == pytest.approx(1, abs=1e-7)
    assert all(max(row.errors_px.values()) < 1e-4 for row in found.anchors)
    assert all(
        len(row.errors_px) == len(point.seen)
        for row, point in zip(found.anchors, points, strict=True)
    )


def test_the_recorded_similarity_is_the_move():
    flown = flight(1)
    before = model_poses(flown.model)
    found = moved(flown, measured(flown.centres)).similarity
    assert found is not None
    for name, pose in model_poses(flown.model).items():
        expected = found.scale * np.asarray(found.rotation) @ before[name].centre
        np.testing.assert_allclose(pose.centre, expected + found.translation, atol=1e-9)


def test_a_left_out_position_is_held_out_by_a_fit_of_the_others():
    flown, rng = flight(2), np.random.default_rng(0)
    given = {n: at + rng.normal(0, 1, 3) for n, at in flown.centres.items()}
    before, names = model_poses(flown.model), sorted(given)
    found = moved(flown, measured(given))
    source = np.asarray([before[name].centre for name in names])
    target = np.asarray([given[name] for name in names])
    for k in (0, 7, 19):
        others = np.arange(len(names)) != k
        fit = umeyama(source[others], target[others])
        np.testing.assert_allclose(
            found.anchors[k].held_out, fit.moved_points(source[k : k + 1])[0] - target[k], atol=1e-9
        )


# -- noise ---------------------------------------------------------------------------------------


def test_the_stated_deviation_of_noisy_gps_is_that_of_the_errors():
    scaled, turns, stated = [], [], []
    for seed in range(DRAWS):
        flown, rng = flight(seed), np.random.default_rng(seed)
        noise = [HORIZONTAL, HORIZONTAL, VERTICAL]
        given = {n: at + rng.normal(size=3) * noise for n, at in flown.centres.items()}
        found = moved(flown, measured(given))
        assert found.expected is not None
        move = flown.move_found()
        middle = np.mean([flown.centres[row.name] for row in found.anchors if row.used], axis=0)
        shift = move.moved_points(middle[None])[0] - middle
        scaled.append([*shift / found.expected.shift, (move.scale - 1) / found.expected.scale])
        turns.append(Rotation.from_matrix(move.rotation).magnitude())
        stated.append(np.radians(found.expected.turn_deg))
    rms = np.sqrt(np.mean(np.square(scaled), axis=0))
    # With 50 draws, the root mean square of unit errors lies within 0.7 .. 1.3 (3 sigma).
    assert (rms > 0.7).all() and (rms < 1.3).all(), rms
    assert np.abs(scaled).max() < 4
    # The turn has two uncertain axes (the tilts) besides the heading, which is more certain.
    ratio = np.sqrt(np.mean(np.square(turns))) / np.sqrt(np.mean(np.square(stated)))
    assert 0.8 < ratio < 1.8, ratio


def test_held_out_control_points_are_as_far_off_as_other_ground():
    held_out, elsewhere = [], []
    for seed in range(DRAWS):
        flown, rng = flight(seed), np.random.default_rng(seed)
        points = surveyed(flown, ground(rng, 8), rng)
        found = moved(flown, measured({}, source="control points", points=points))
        assert found.held_out is not None
        held_out.append(found.held_out.total)
        check = ground(rng, 10)
        elsewhere.append(np.linalg.norm(flown.move_found().moved_points(check) - check, axis=1))
    errors = np.sqrt(np.mean(np.square(elsewhere)))
    # A held-out point has its own error on top of that of the move.
    assert 0.3 < errors / np.sqrt(np.mean(np.square(held_out))) < 1.0
    assert errors < 0.06  # the ground has 0.06 m for each pixel


# -- wrong positions -----------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [1, 4])
def test_wrong_positions_are_named_and_do_not_move_the_model(wrong):
    flown, rng = flight(3), np.random.default_rng(3)
    given = {n: at + rng.normal(0, 1, 3) for n, at in flown.centres.items()}
    bad = sorted(given)[:: len(given) // wrong][:wrong]
    for k, name in enumerate(bad):
        given[name] = given[name] + [60.0, -30 * k, 20]
    found = moved(flown, measured(given))
    assert found.outliers == bad
    assert found.residual is not None and found.residual.total < 2.5
    assert np.linalg.norm(flown.move_found().moved_points(np.zeros((1, 3)))) < 3


def test_of_good_positions_hardly_any_is_called_wrong():
    called, total = 0, 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        n = 5 + seed % 8
        source = rng.normal(size=(n, 3)) * [30, 30, 3]
        target = source + rng.normal(size=(n, 3))
        _, used = robust_similarity(Anchors(source, target, np.ones(n)))
        called, total = called + int((~used).sum()), total + n
    assert called / total < 0.03


def test_positions_with_small_expected_errors_count_more():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(12, 3)) * 30
    deviation = np.r_[np.full(6, 0.02), np.full(6, 5.0)]
    target = source + rng.normal(size=(12, 3)) * deviation[:, None]
    similarity, used = robust_similarity(Anchors(source, target, deviation))
    assert used.all()
    assert np.abs(similarity.moved_points(source[:6]) - target[:6]).max() < 0.1


def test_one_wrong_click_does_not_move_the_point():
    flown = flight()
    point = np.asarray([50.0, 30.0, 0.0])
    seen = {name: tuple(xy.tolist()) for name, xy in flown.seen(point).items()}
    first = min(seen)
    seen[first] = (seen[first][0] + 80, seen[first][1])
    found = triangulated(views_by_name(flown.truth), seen)
    assert found is not None and np.linalg.norm(found.xyz - point) < 0.3
    assert max(found.errors_px, key=lambda name: found.errors_px[name]) == first
    assert found.errors_px[first] > 60


# -- what determines no move ---------------------------------------------------------------------


def untouched(flown: Flight, given: MeasuredPositions) -> str:
    """Why the model was not moved; it is as it was."""
    before = {name: pose.centre for name, pose in model_poses(flown.model).items()}
    found = moved(flown, given)
    assert found.similarity is None and found.why_not is not None
    for name, pose in model_poses(flown.model).items():
        assert (pose.centre == before[name]).all()
    return found.why_not


def test_two_positions_or_positions_on_a_line_do_not_move_the_model():
    flown = flight()
    two = dict(list(flown.centres.items())[:2])
    assert "has 2 photos" in untouched(flown, measured(two))
    line = {name: [3.0 * k, 4.0 * k, 80] for k, name in enumerate(flown.centres)}
    assert "on one line" in untouched(flown, measured(line))


def test_positions_without_heights_are_told_and_do_not_move_the_model():
    flown = flight()
    flat = {name: Position(at[0], at[1], None) for name, at in flown.centres.items()}
    given = measured({}, positions=flat)
    assert given.frame() is None
    found = moved(flown, given)
    assert found.similarity is None and "height" in (found.why_not or "")
    assert set(found.unused) == set(flat)
    some = {n: at for n, at in flown.centres.items() if n < "12.jpg"}
    mixed = measured(some, positions=flat | measured(some).positions)
    found = moved(flown, mixed)
    assert len(found.anchors) == 12 and set(found.unused) == set(flat) - set(some)


def test_auto_leaves_a_small_scene_with_poor_gps_as_it_is():
    flown, rng = flight(), np.random.default_rng(0)
    centre = np.mean(list(flown.centres.values()), axis=0)
    given = {  # the same flight in the size of a table
        name: centre + 0.02 * (at - centre) + rng.normal(0, 3, 3)
        for name, at in flown.centres.items()
    }
    assert "uncertain" in untouched(flown, measured(given, sure=True))
    assert moved(flown, measured(given)).similarity is not None


def test_a_control_point_that_one_photo_shows_is_not_used():
    flown, rng = flight(), np.random.default_rng(0)
    points = surveyed(flown, ground(rng, 5))
    lonely = dataclasses.replace(points[0], seen=points[0].seen[:1])
    given = measured({}, source="control points", points=[lonely, *points[1:]])
    found = moved(flown, given)
    assert found.unused == {"P0": "1 photos of the model show it; at least 2 are needed"}
    assert [row.name for row in found.anchors] == ["P1", "P2", "P3", "P4"]


def test_each_model_is_moved_by_itself():
    first, second = flight(), flight(5)
    found = move_models([first.model, second.model], measured(first.centres | second.centres))
    assert len(found.models) == 2
    scales = {each.similarity.scale for each in found.models if each.similarity}
    assert len(scales) == 2


def test_far_local_coordinates_get_an_offset_of_whole_metres():
    flown = flight()
    far = {n: at + [500000.25, 5100000.5, 300.0] for n, at in flown.centres.items()}
    result = move_models([flown.model], measured(far))
    assert result.frame is not None and result.frame.axes == "x, y, z"
    offset = np.asarray(result.frame.offset)
    assert (offset == np.round(offset)).all() and (offset > [5e5, 5e6, 300]).all()
    poses = model_poses(flown.model)
    for name, at in far.items():
        np.testing.assert_allclose(poses[name].centre + offset, at, atol=1e-6)
    near = move_models([flight().model], measured(flown.centres))
    assert near.frame is not None and near.frame.offset == (0.0, 0.0, 0.0)


def test_the_same_positions_give_the_same_bytes(tmp_path):
    for k in range(2):
        flown = flight()
        rng = np.random.default_rng(0)
        given = {n: at + rng.normal(0, 1, 3) for n, at in flown.centres.items()}
        moved(flown, measured(given))
        (tmp_path / str(k)).mkdir()
        pycolmap.Reconstruction(flown.model).write_binary(tmp_path / str(k))
    for file in (tmp_path / "0").iterdir():
        assert file.read_bytes() == (tmp_path / "1" / file.name).read_bytes()
