"""Laws of scale drift in a part of a model: seen by depths only, as nothing else shows it."""

import dataclasses

import numpy as np
import pytest
from room_scene import view_of
from strategies import rng_of
from verdicts import check_of
from wall_scene import REFINEMENT, big_wall, cameras, poster, scene, true_matches

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.sfm.check.check_model import (
    MOST_SPREAD,
    OUTER,
    VerifiedMatches,
    check_model,
    median_depths,
    scale_drift,
)


def seeing_at(*depths: float) -> Model:
    """Views that look along the z-axis at nine points each; a view of depth 0 has no points."""
    views = [
        view_of(CameraPose(np.eye(3), np.asarray([k, 0.0, 0.0])), k) for k in range(len(depths))
    ]
    seeing = [k for k, depth in enumerate(depths) if depth]
    noise = rng_of(0).uniform(-0.1, 0.1, (len(seeing), 9, 3))
    noise[:, :, 2] = [-0.2, -0.1, -0.1, -0.1, 0, 0.1, 0.1, 0.1, 0.2]  # the median is exact
    points = np.concatenate(
        [np.zeros((0, 3))]
        + [
            views[k].centre + depths[k] * ([0, 0, 1] + own)
            for k, own in zip(seeing, noise, strict=True)
        ]
    )
    count = len(points)
    return Model(
        views, Tracks(points, np.arange(count), np.repeat(seeing, 9), np.zeros((count, 2)))
    )


def names(*numbers: int) -> list[str]:
    return [f"{k}.png" for k in numbers]


def test_depths_are_medians_along_the_axis_of_the_view():
    found = median_depths(seeing_at(2.0, 0, 50.0))
    np.testing.assert_allclose(found, [2.0, np.nan, 50.0])


@pytest.mark.parametrize(("nearer", "found"), [(0.99, []), (1.01, names(0, 2, 4))])
def test_the_scale_has_drifted_if_its_photos_see_their_points_a_hundred_times_nearer(nearer, found):
    far = nearer * MOST_SPREAD
    assert scale_drift(seeing_at(1, far, 1, far, 1, far)) == found


def test_photos_without_points_and_with_points_behind_them_say_nothing():
    assert scale_drift(seeing_at(0, 0, 0)) == []
    assert scale_drift(seeing_at(1, -500, 1, 0, 1, -500)) == []
    assert scale_drift(seeing_at(1, -500, 500, 0, 1, 500)) == names(0, 4)


@pytest.mark.parametrize(("bad", "found"), [(1, False), (3, True)])
def test_a_single_misplaced_photo_among_many_is_no_part(bad, found):
    assert OUTER == 5
    depths = [1e-6] * bad + [1.0] * (30 - bad)
    assert bool(scale_drift(seeing_at(*depths))) == found


def with_drifted_scale(model: Model, views: list[int], factor: float) -> Model:
    """The model, in which some views and the points that they see shrink towards the first of them.

    Points that other views see, too, are there twice.
    """
    tracks, about = model.tracks, model.views[views[0]].centre

    def smaller(x: np.ndarray) -> np.ndarray:
        return about + (x - about) / factor

    point = np.where(np.isin(tracks.view, views), tracks.point + len(tracks.points), tracks.point)
    moved: list[View] = [
        dataclasses.replace(view, centre=smaller(view.centre)) if k in views else view
        for k, view in enumerate(model.views)
    ]
    points = np.concatenate([tracks.points, smaller(tracks.points)])
    both = tracks._replace(points=points, point=point)
    return Model(moved, both.select_points(np.unique(point)))


def test_a_part_that_shrinks_keeps_its_pixels_and_is_found_by_the_check():
    seen = scene([([big_wall(), poster(1)], cameras([-10.0, -4.0, 3.0, -7.0, 0.0, 8.0]))])
    model = with_drifted_scale(seen.model, [3, 4, 5], 300.0)
    for k, view in enumerate(model.views):
        rows = model.rows[k]
        xy, _ = view.project(model.tracks.points[model.tracks.point[rows]])
        np.testing.assert_allclose(xy, model.tracks.xy[rows], atol=1e-6)
    assert scale_drift(seen.model) == [] and scale_drift(model) == names(3, 4, 5)
    results = [true_matches(seen.model, a, b) for a in range(6) for b in range(a + 1, 6)]
    matches = {result.pair: result for result in results}
    given = VerifiedMatches(matches, matches.keys(), 0)
    found = check_model(model, seen.images, given, REFINEMENT)
    assert found is not None and found.check.scale_drift == names(3, 4, 5)
    assert found.check.verdict != "green" and found.check.doubted()


def test_scale_drift_alone_makes_a_verdict_amber():
    check = dataclasses.replace(check_of("green"), scale_drift=["checked0.jpg", "checked3.jpg"])
    assert check.verdict == "amber" and check.doubted()
