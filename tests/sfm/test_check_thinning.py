"""Laws of which points of a model are tested."""

import dataclasses

import numpy as np
import pytest
from wall_scene import big_wall, cameras, poster, scene

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.sfm.check import check_model as module
from jaxsfm.sfm.check.check_model import FACING, thinned

ANGLES = [-10.0, -4.0, 3.0, -7.0, 0.0, 8.0]


def random_tracks(points: int, views: int) -> Tracks:
    rng = np.random.default_rng(0)
    point, view = np.nonzero(rng.random((points, views)) < 0.5)
    return Tracks(rng.normal(size=(points, 3)), point, view, rng.normal(size=(len(point), 2)))


def test_a_thinned_model_has_few_points_per_view_taken_evenly_with_their_observations(monkeypatch):
    views = scene([([big_wall()], cameras([0.0, 5.0]))]).model.views
    model = Model(views, random_tracks(70, 2))
    small = thinned(model, per_view=10)
    assert len(small.tracks.points) == 10 * 2 and small.views == views
    rows = [int(np.flatnonzero((model.tracks.points == p).all(1))[0]) for p in small.tracks.points]
    assert set(np.diff(rows)) == {3, 4} and rows[0] < 4 and rows[-1] > 65
    for k, row in enumerate(rows):
        one, other = (
            small.tracks.select(small.tracks.point == k),
            model.tracks.select(model.tracks.point == row),
        )
        np.testing.assert_array_equal(one.view, other.view)
        np.testing.assert_array_equal(one.xy, other.xy)
    for one, other in zip(small.tracks, thinned(model, per_view=10).tracks, strict=True):
        np.testing.assert_array_equal(one, other)
    few = Model(views, random_tracks(20, 2))
    assert thinned(few, per_view=10) is few
    assert thinned(model) is model
    monkeypatch.setattr(module, "OBSERVED_PER_VIEW", 20)
    per_point = len(model.tracks.point) / 70
    assert len(thinned(model).tracks.points) == int(20 * 2 / per_point) < 70
    monkeypatch.setattr(module, "MAX_POINTS", 5)
    assert len(thinned(model).tracks.points) == 5


def test_a_view_has_few_points_to_try_whether_it_observes_them_or_not(monkeypatch):
    seen = scene([([big_wall(), poster(1)], cameras(ANGLES))]).model
    points, views, tracks = seen.tracks.points, seen.views, seen.tracks
    shown = 0
    for k, point in enumerate(points):
        rays = [view.centre - point for view in views]
        rays = np.asarray([ray / np.linalg.norm(ray) for ray in rays])
        side = rays[tracks.view[tracks.point == k]].mean(axis=0)
        for view, ray in zip(views, rays, strict=True):
            (xy,), _ = view.project(point[None])
            inside = (-0.5 < xy).all() and (xy < np.asarray(view.size) - 0.5).all()
            shown += bool(inside and ray @ side / np.linalg.norm(side) > FACING)
    monkeypatch.setattr(module, "TRIED_POINTS", len(points))
    of_a_point = module._views_of_a_point(seen)
    assert of_a_point == pytest.approx(shown / len(points))
    monkeypatch.setattr(module, "TRIED_PER_VIEW", 30)
    few = thinned(seen)
    assert len(few.tracks.points) == int(30 * len(views) / of_a_point) < len(points)
    tried = module._views_of_a_point(few) * len(few.tracks.points) / len(views)
    assert tried == pytest.approx(30, rel=0.25)


def test_views_from_the_other_side_have_nothing_to_try():
    """Around an object, every view has all points inside, but shows half of them at most."""
    front = scene([([big_wall()], cameras(ANGLES))]).model
    behind = [
        dataclasses.replace(
            view,
            rotation=view.rotation @ np.diag([-1.0, 1.0, -1.0]),
            centre=2 * front.tracks.points.mean(axis=0) - view.centre,
        )
        for view in front.views
    ]
    both = Model([*front.views, *behind], front.tracks)
    xy, depth = behind[0].project(front.tracks.points)
    assert (depth > 0).all() and ((xy > 0) & (xy < np.asarray(behind[0].size))).all(1).mean() > 0.5
    assert module._views_of_a_point(both) == pytest.approx(module._views_of_a_point(front))
