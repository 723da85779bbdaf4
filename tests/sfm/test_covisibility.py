"""Laws of the parts of a refined model that points of three views hold together."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from room_scene import arrays, noisy_model, other_scene
from scipy.cluster.hierarchy import DisjointSet
from test_refined_models import NAMES, FakePhotos

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.reconstruction import registered
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.config import Config, Refinement
from jaxsfm.sfm import refined_models
from jaxsfm.sfm.refine.octave_pose import MIN_COUNT
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refine.weak_views import RegistrationAttempt, taken_out
from jaxsfm.sfm.refined_models import Believed, covisibility_components, refine_models

VIEWS = 6


def tracks_of(points: list[set[int]]) -> Tracks:
    """Tracks of points that these views see."""
    point = [k for k, views in enumerate(points) for _ in views]
    view = [each for views in points for each in sorted(views)]
    many = len(point)
    return Tracks(
        np.zeros((len(points), 3)),
        np.asarray(point, np.int64),
        np.asarray(view, np.int64),
        np.zeros((many, 2)),
    )


def slow_parts(points: list[set[int]]) -> list[list[int]]:
    joined = DisjointSet(range(VIEWS))
    for a, b in itertools.combinations(range(VIEWS), 2):
        if sum({a, b} <= views and len(views) > 2 for views in points) >= MIN_COUNT:
            joined.merge(a, b)
    parts = [sorted(int(k) for k in part) for part in joined.subsets()]
    return sorted(parts, key=lambda part: (-len(part), part))


SEEN = st.sets(st.integers(0, VIEWS - 1), min_size=2, max_size=4)
TIMES = st.integers(MIN_COUNT // 2, MIN_COUNT)


@given(st.lists(st.tuples(SEEN, TIMES), max_size=8))
def test_views_are_one_part_if_a_chain_of_shared_points_of_three_views_joins_them(groups):
    points = [views for views, times in groups for _ in range(times)]
    assert covisibility_components(tracks_of(points), VIEWS) == slow_parts(points)


@pytest.mark.parametrize(
    ("views", "times", "parts"),
    [
        ({0, 1, 2}, MIN_COUNT, [[0, 1, 2], [3]]),
        ({0, 1, 2}, MIN_COUNT - 1, [[0], [1], [2], [3]]),
        ({0, 1}, 10 * MIN_COUNT, [[0], [1], [2], [3]]),  # no third view shows them
    ],
)
def test_a_third_view_must_show_enough_points(views, times, parts):
    assert covisibility_components(tracks_of([views] * times), 4) == parts


DONE = RefinementFigures(passes=[], registrations=[taken_out("gone", 3)])


@pytest.fixture
def held(rendered, monkeypatch):
    """What is left of the room's model, if only some of its points are seen by some views."""

    def run(*seen: set[int], done: RefinementFigures = DONE, weak_octaves: int = 4) -> Any:
        model = arrays(noisy_model(rendered, 0.0), rendered)
        tracks, group = model.tracks, np.arange(len(model.tracks.points)) % len(seen)
        keep = [view in seen[group[k]] for k, view in zip(tracks.point, tracks.view, strict=True)]
        few = model.with_tracks(tracks.select(np.asarray(keep))).to_colmap()
        monkeypatch.setattr(refined_models, "refine_model", lambda *_, **__: (few, done))
        monkeypatch.setattr(refined_models, "colour_points", lambda *_: None)
        monkeypatch.setattr(refined_models, "other_camera", lambda *_, **__: None)
        return refine_models(
            [few],
            FakePhotos(rendered),  # pyright: ignore[reportArgumentType]
            Believed(Any, {}),  # pyright: ignore[reportArgumentType]
            config=Config(refinement=Refinement(weak_octaves=weak_octaves)),
            options=MapOptions(refine_intrinsics=False, threads=1),
        )

    return run


def test_a_model_that_holds_together_stays_as_it_is(held):
    made = held({*range(5)})
    assert [registered(model) for model in made.models] == [{*NAMES}] and made.order == [0]
    (done,) = made.figures
    assert done.holds and [row.name for row in done.registrations] == ["gone"]


def test_views_that_only_pairs_hold_lose_their_places(held):
    made = held({0, 1, 2}, {3, 4})
    assert [registered(model) for model in made.models] == [{*NAMES[:3]}] and made.order == [0]
    (done,) = made.figures
    assert done.holds and [row.name for row in done.registrations] == ["gone", *NAMES[3:]]
    assert all(row.held is not None and row.held > 0 for row in done.registrations)


def test_a_model_of_which_nothing_holds_stays_and_is_not_confirmed(held):
    made = held({0, 1}, {1, 2}, {2, 3}, {3, 4})
    assert [registered(model) for model in made.models] == [{*NAMES}]
    (done,) = made.figures
    accepted: Any = [type("Pass", (), {"accepted": True})]
    assert not done.holds and not dataclasses.replace(done, passes=accepted).confirmed
    assert dataclasses.replace(done, passes=accepted, holds=True).confirmed


def weak_in(*passes: bool, octave_px: int | None) -> RefinementFigures:
    """The figures of passes, in some of which the third view is weak, and of its placing."""
    view = RegistrationAttempt(
        name=NAMES[2],
        registered=True,
        octave_px=octave_px,
        candidates=230,
        agreed=11,
        error_px=None if octave_px is None else 1.0,
    )
    each: Any = [
        type("Pass", (), {"accepted": True, "weak_views": [NAMES[2]] if weak else []})
        for weak in passes
    ]
    return RefinementFigures(passes=each, registrations=[view])


@pytest.mark.parametrize(
    ("done", "weak_octaves", "stays"),
    [
        (weak_in(False, True, octave_px=None), 4, False),
        (weak_in(False, True, octave_px=2), 4, True),  # an octave has confirmed its pose
        (weak_in(True, False, octave_px=None), 4, True),  # the last pass has aligned it
        (weak_in(False, True, octave_px=None), 0, True),  # no octave was asked
    ],
)
def test_the_observations_of_a_view_that_nothing_confirms_hold_nothing(
    held, done, weak_octaves, stays
):
    made = held({*range(5)}, done=done, weak_octaves=weak_octaves)
    gone = set() if stays else {NAMES[2]}
    assert [registered(model) for model in made.models] == [{*NAMES} - gone]
    (row,) = made.figures[0].registrations
    assert (row.name, row.candidates, row.agreed) == (NAMES[2], 230, 11)
    assert (row.held is None) == stays


def test_the_refinement_takes_out_a_photo_of_another_place(rendered, monkeypatch):
    """It has observations, which agree with its pose, and shows something else."""
    elsewhere = rendered._replace(images=rendered.images | {NAMES[2]: other_scene(0)})
    for name in ("with_all_points", "colour_points"):
        monkeypatch.setattr(refined_models, name, lambda model, *_, **__: model)
    monkeypatch.setattr(refined_models, "other_camera", lambda *_, **__: None)
    made = refine_models(
        [noisy_model(rendered, 0.7)],
        FakePhotos(elsewhere),  # pyright: ignore[reportArgumentType]
        Believed(Any, {}),  # pyright: ignore[reportArgumentType]
        config=Config(refinement=Refinement()),
        options=MapOptions(refine_intrinsics=False, threads=1),
    )
    assert [registered(model) for model in made.models] == [{*NAMES} - {NAMES[2]}]
    (row,) = made.figures[0].registrations
    assert row.name == NAMES[2] and row.held is not None and row.held >= MIN_COUNT


def test_each_part_that_is_large_enough_is_a_model_of_its_own(held, monkeypatch):
    monkeypatch.setattr(refined_models, "MIN_VIEWS", 2)
    monkeypatch.setattr(refined_models, "covisibility_components", lambda *_: [[0, 1], [3, 4], [2]])
    made = held({0, 1}, {3, 4}, {2, 3})
    sizes = [registered(model) for model in made.models]
    assert sizes == [{*NAMES[:2]}, {*NAMES[3:]}] and made.order == [0, 0]
    first, second = made.figures
    assert [row.name for row in first.registrations] == [
        "gone",
        NAMES[2],
    ] and second.registrations == []
