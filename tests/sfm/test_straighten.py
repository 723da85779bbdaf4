"""Laws of the adjustment of long rows of photos, on a bent row of exact cameras."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from jaxsfm.bench.synthetic import camera_matrix
from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose, model_poses
from jaxsfm.colmap.tracks import Observations, Tracks
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.photos import Pixels
from jaxsfm.sfm.evaluation import Similarity, evaluate
from jaxsfm.sfm.parts import straighten
from jaxsfm.sfm.parts.straighten import (
    LONG,
    STRONGEST,
    TIED,
    TOGETHER,
    hops,
    seen_together,
    shared_views,
    straightened,
)
from jaxsfm.sfm.refine import one_pass

SIZE, STEP, DEPTH = (320, 240), 1.0, 4.0
NOISE_PX = 0.1
HOW = {"loss_px": 1.0, "threads": 1}


def row(count: int, *, per_photo: int = 30, seed: int = 0) -> Model:
    """Photos along a wall with points before it, each observed where it is, up to the noise."""
    rng = np.random.default_rng(seed)
    k = camera_matrix(SIZE)
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", k[0, 0], *SIZE)
    length = STEP * count
    spread = (length + 4, 4.0, 1.5)
    points = rng.uniform(-0.5, 0.5, (per_photo * count, 3)) * spread + (length / 2, 0, DEPTH)
    views = [
        View(
            image_id=n + 1,
            name=f"{n:03d}.png",
            rotation=Rotation.from_euler("xyz", rng.normal(0, 2, 3), degrees=True).as_matrix(),
            centre=np.asarray([STEP * n, *rng.uniform(-0.3, 0.3, 2)]),
            camera=camera,
            pixels=Pixels((1.0, 1.0)),
            size=SIZE,
        )
        for n in range(count)
    ]
    parts = []
    for n, view in enumerate(views):
        xy, depth = view.project(points)
        rows = np.flatnonzero(((xy > 0) & (xy < np.asarray(SIZE) - 1)).all(1) & (depth > 0))
        noisy = xy[rows] + rng.normal(0, NOISE_PX, (len(rows), 2))
        parts.append((rows, np.full(len(rows), n), noisy))
    point, view, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    seen = np.bincount(point, minlength=len(points)) >= 2
    tracks = Tracks(points, point, view, xy).select_points(np.flatnonzero(seen))
    return Model(views, tracks, {1: camera})


def bent(model: Model, degrees: float) -> Model:
    """The row along an arc: what it shows hardly changes from photo to photo."""
    length = model.views[-1].centre[0]
    radius = length / np.radians(degrees)

    def turn(x: float) -> np.ndarray:
        return Rotation.from_rotvec([0, x / radius, 0]).as_matrix()

    def moved(at: np.ndarray) -> np.ndarray:
        middle = np.asarray([0, 0, -radius])
        return turn(at[0]) @ (np.asarray([0, at[1], at[2]]) - middle) + middle

    views = [
        dataclasses.replace(v, rotation=v.rotation @ turn(v.centre[0]).T, centre=moved(v.centre))
        for v in model.views
    ]
    points = np.stack([moved(point) for point in model.tracks.points])
    return Model(views, model.tracks._replace(points=points), model.cameras)


def poses(model: Model) -> dict[str, CameraPose]:
    return {view.name: CameraPose(view.rotation, view.centre) for view in model.views}


def off(model: Model, truth: Model) -> float:
    """The mean error of the positions, in units of the row."""
    return evaluate(poses(model), poses(truth)).position["mean"]


@pytest.fixture(scope="module")
def long_row() -> Model:
    return row(240)


def test_a_bent_row_becomes_straight_and_the_solver_alone_leaves_it_bent(long_row):
    wrong = bent(long_row, 30.0)
    found = straightened(wrong, error_px=4.0, **HOW)
    assert found is not None and {v.name for v in found.views} == {v.name for v in wrong.views}
    left = []
    for model in (found, wrong):
        whole = model.to_colmap()
        bundle_adjust(whole, refine_intrinsics=False, **HOW)
        left.append(evaluate(model_poses(whole), poses(long_row)).position["mean"])
    assert left[0] < 0.3 and left[1] > 2.0 and off(found, long_row) < 1.0 < off(wrong, long_row)


def test_a_straight_row_stays_straight(long_row):
    found = straightened(long_row, error_px=4.0, **HOW)
    assert found is not None and off(found, long_row) < 0.3
    assert np.median(found.errors_px()) < 2 * NOISE_PX


def test_only_long_rows_are_straightened():
    short = row(30)
    assert hops(seen_together(short)) < LONG <= hops(seen_together(row(120)))
    assert straightened(bent(short, 30.0), error_px=4.0, **HOW) is None


def test_rows_that_nothing_connects_stay_as_they_are(long_row):
    """Each of them is long, but nothing says how they lie to each other."""
    middle = len(long_row.views) // 2
    across = np.zeros((len(long_row.tracks.points), 2), bool)
    across[long_row.tracks.point, (long_row.tracks.view < middle).astype(int)] = True
    torn = long_row.select(~across.all(1)[long_row.tracks.point])
    assert hops(seen_together(row(middle))) >= LONG
    assert straightened(torn, error_px=4.0, **HOW) is None


def test_a_row_whose_parts_do_not_fit_together_stays_as_it_is(long_row, monkeypatch):
    found = straighten.common_frames

    def one_is_too_large(count, shared):
        (frames,) = found(count, shared)
        return [frames | {1: frames[1]._replace(scale=1.2 * frames[1].scale)}]

    monkeypatch.setattr(straighten, "common_frames", one_is_too_large)
    assert straightened(long_row, error_px=4.0, **HOW) is None
    monkeypatch.setattr(straighten, "common_frames", found)
    monkeypatch.setattr(straighten, "shared_views", lambda *_: None)
    assert straightened(long_row, error_px=4.0, **HOW) is None


def with_points_of_both_ends(model: Model, count: int) -> Model:
    """The row, and points far away that its first and its last photo see."""
    length = model.views[-1].centre[0]
    far = np.random.default_rng(1).uniform(-0.5, 0.5, (count, 3)) * (200, 200, 0)
    far += (length / 2, 0, 20 * length)
    ends = (0, len(model.views) - 1)
    rows = np.arange(count)
    seen = [
        Observations(rows, np.full(count, k), model.views[k].project(far)[0] + 0.0) for k in ends
    ]
    return model.with_tracks(model.tracks.joined(Tracks.from_parts(far, seen)))


@pytest.mark.parametrize(("count", "kept"), [(TIED - 1, True), (TIED, False)])
def test_the_ends_of_a_row_are_not_torn_apart(long_row, count, kept):
    """Points of both ends are few, so the share of right observations says nothing."""
    before = with_points_of_both_ends(long_row, count)
    home = [(k // 40, view) for k, view in enumerate(before.views)]
    after = bent(before, 2.0)
    assert (after.errors_px() < 4.0).mean() > 0.9
    assert straighten._stays_tied(before, before, home, 4.0)
    assert straighten._stays_tied(before, after, home, 4.0) == kept


def test_a_weak_photo_does_not_keep_a_row_bent(long_row):
    """It shares fewer points with each other photo than photos need to hold each other."""
    weak = 100
    rows = long_row.rows[weak]
    drop = np.zeros(len(long_row.tracks.point), bool)
    drop[rows[TOGETHER - 5 :]] = True
    some = long_row.select(~drop)
    many = np.flatnonzero(some.tracks.num_observations() >= 2)
    wrong = bent(some.with_tracks(some.tracks.select_points(many)), 30.0)
    found = straightened(wrong, error_px=4.0, **HOW)
    assert found is not None and off(found, long_row) < 1.0


def test_observations_cameras_and_photos_stay(long_row):
    wrong = bent(long_row, 30.0)
    found = straightened(wrong, error_px=4.0, **HOW)
    assert found is not None
    assert [view.name for view in found.views] == [view.name for view in wrong.views]
    assert all(a.camera is b.camera for a, b in zip(found.views, wrong.views, strict=True))
    for field in ("point", "view", "xy"):
        np.testing.assert_array_equal(
            getattr(found.tracks, field), getattr(wrong.tracks, field), field
        )


def test_a_point_that_is_in_no_part_moves_with_the_first_view_that_observes_it(long_row):
    wrong = bent(with_points_of_both_ends(long_row, 3), 30.0)
    found = straightened(wrong, error_px=4.0, **HOW)
    assert found is not None
    (was, _), (now, _) = (m.views[0].project(m.tracks.points[-3:]) for m in (wrong, found))
    np.testing.assert_allclose(now, was, atol=1e-6)
    assert np.abs(found.tracks.points[-3:] - wrong.tracks.points[-3:]).max() > 1.0


def test_a_point_that_lost_all_its_observations_does_no_harm(long_row):
    """The filter before an adjustment takes observations out, and leaves points."""
    seen = long_row.select(long_row.tracks.point != 7)
    found = straightened(bent(seen, 30.0), error_px=4.0, **HOW)
    assert found is not None and np.isfinite(found.tracks.points).all()


def test_photos_with_few_common_points_do_not_hold_each_other(long_row):
    graph = seen_together(long_row)
    seen = [set(long_row.tracks.point[rows].tolist()) for rows in long_row.rows]
    common = [len(seen[20] & seen[k]) if k != 20 else 0 for k in range(len(seen))]
    strongest = sorted(common)[-STRONGEST]
    weights = graph.weights[[20]].toarray()[0]
    assert all(
        weights[k] == (count if count >= min(TOGETHER, strongest) else 0)
        for k, count in enumerate(common)
        if count != strongest
    )
    assert any(0 < count < TOGETHER for count in common) and graph.weights.diagonal().sum() == 0


@pytest.mark.parametrize("straight", [False, True])
def test_shared_photos_say_how_models_lie_to_each_other_even_along_a_line(straight):
    """The centres of a straight row do not say how it is turned about itself; the axes do."""
    views = row(8).views
    if straight:
        views = [dataclasses.replace(v, centre=v.centre * (1, 0, 0)) for v in views]
    turn = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
    true = Similarity(2.5, turn, np.asarray([1.0, -2.0, 3.0]))
    at = [true.moved(CameraPose(v.rotation, v.centre)) for v in views]
    second = [
        dataclasses.replace(v, rotation=p.rotation, centre=p.centre)
        for v, p in zip(views, at, strict=True)
    ]
    found = shared_views(second, views)
    assert found is not None
    np.testing.assert_allclose(found.similarity.rotation, true.rotation, atol=1e-9)
    np.testing.assert_allclose(found.similarity.translation, true.translation, atol=1e-9)
    assert found.similarity.scale == pytest.approx(2.5)
    np.testing.assert_allclose(found.similarity.moved_points(found.second), found.first, atol=1e-9)


def test_models_that_share_two_photos_or_one_place_are_not_put_together():
    views = row(8).views
    assert shared_views(views[:4], views[2:]) is None
    there = [dataclasses.replace(v, centre=np.zeros(3)) for v in views]
    assert shared_views(there, views) is None


@pytest.mark.parametrize(("is_long", "adjusted"), [(False, 2), (True, 1)])
def test_the_parts_of_a_long_row_take_the_place_of_the_first_adjustment(
    monkeypatch, is_long, adjusted
):
    model, calls = row(12), []
    monkeypatch.setattr(one_pass, "straightened", lambda given, **_: given if is_long else None)
    monkeypatch.setattr(one_pass, "bundle_adjust", lambda *_, **how: calls.append(how))
    settings = one_pass.PassSettings(Refinement(), refine_intrinsics=False, threads=1)
    found = one_pass._adjust(model, np.zeros(0, int), settings)
    assert found is not None and len(calls) == adjusted
    assert len(found.model.views) == len(model.views)
