"""Laws of places that registration refuses, on rendered walls."""

import functools

import numpy as np
import pytest
from wall_scene import (
    REFINEMENT,
    Scene,
    big_wall,
    cameras,
    matched,
    picture,
    scene,
    true_matches,
)

from jaxsfm.io.pairs import PairResult
from jaxsfm.sfm.refine.fixed_structure import ResectionMatches
from jaxsfm.sfm.register import grow as module
from jaxsfm.sfm.register.grow import ExtendedModels, grow
from jaxsfm.sfm.register.locate_view import UnregisteredView

NEW = 5
NAMES = [f"{k}.png" for k in range(NEW + 1)]


@functools.cache
def wall_with_poster(own: int) -> Scene:
    """A wall with poster 1, seen by five views, and a view of the wall with a poster of its own.

    The new view has observations of the wall alone.
    """
    wall = big_wall()
    first, second = (picture(seed, left=-1.0, width=2.0, height=2.0, z=-0.002) for seed in (1, own))
    known = ([wall, first], cameras([-10.0, -6.0, -2.0, 5.0, 9.0]))
    seen = scene([known, ([wall, second], cameras([3.0]))])
    tracks = seen.model.tracks
    keep = (tracks.view != NEW) | (seen.plane == 0)[tracks.point]
    return seen._replace(model=seen.model.select(keep))


def grown(seen: Scene, *others: PairResult) -> ExtendedModels:
    """The model of the five views, in which the new one was looked for by matches with each.

    `others` replace the right matches of their pairs.
    """
    known = seen.model.part(set(NAMES[:NEW]))[0]
    pairs = [*(true_matches(seen.model, k, NEW) for k in range(NEW)), *others]
    return grow(
        [known],
        {NAMES[NEW]: UnregisteredView([seen.model.views[NEW]], False, NAMES[:NEW])},
        ResectionMatches({each.pair: each for each in pairs}, 0),
        seen.images,
        refinement=REFINEMENT,
    )


def displaced(result: PairResult) -> PairResult:
    """Matches that agree with each other, and say that the photo was taken elsewhere."""
    return matched(result.pair, result.keypoints0, result.keypoints1 + [60.0, 0.0])


def test_a_view_gets_a_place_that_nothing_contradicts():
    seen = wall_with_poster(1)
    found = grown(seen)
    assert found.registered == {NAMES[NEW]: 0} and found.located[NAMES[NEW]].why is None
    (model,) = found.models
    assert [view.name for view in model.views] == NAMES
    off = np.linalg.norm(model.views[NEW].centre - seen.model.views[NEW].centre)
    assert off < 0.02


def refused(found: ExtendedModels, why: str) -> None:
    assert found.registered == {}
    located, (model,) = found.located[NAMES[NEW]], found.models
    assert why in (located.why or "") and located.candidates > 30
    assert not located.trusted and located.points is None and located.octave_px is None
    assert [view.name for view in model.views] == NAMES[:NEW]


def test_a_place_where_the_photo_shows_something_else_is_refused():
    refused(grown(wall_with_poster(2)), "it shows something else instead of")


def test_a_place_that_the_photo_taken_before_contradicts_is_refused():
    seen = wall_with_poster(1)
    away = displaced(true_matches(seen.model, NEW - 1, NEW))
    refused(grown(seen, away), f"its neighbour {NAMES[NEW - 1]} do not agree")


def test_photos_that_were_not_taken_next_contradict_no_place():
    """Matches of photos that are far apart are false more often than places are."""
    seen = wall_with_poster(1)
    away = displaced(true_matches(seen.model, 0, NEW))
    assert grown(seen, away).registered == {NAMES[NEW]: 0}


@pytest.mark.parametrize(("against", "registered"), [({}, [NAMES[NEW]]), ({NAMES[NEW]: "why"}, [])])
def test_a_view_is_asked_about_once_and_a_refused_one_leaves_the_model_as_it_was(
    monkeypatch, against, registered
):
    asked, seen = [], wall_with_poster(1)
    monkeypatch.setattr(module, "objections", lambda *given: asked.append(given) or against)
    found = grown(seen)
    assert [*found.registered] == registered and found.rounds == 1 and len(asked) == 1
    whole, details, following, _ = asked[0]
    assert [view.name for view in whole.model.views] == NAMES and details == {NAMES[NEW]: True}
    assert set(following) == {(NAMES[NEW - 1], NAMES[NEW])}
    known = seen.model.part(set(NAMES[:NEW]))[0].tracks
    if not registered:
        np.testing.assert_array_equal(found.models[0].tracks.xy, known.xy)
    assert (len(found.models[0].tracks.xy) > len(known.xy)) == bool(registered)
