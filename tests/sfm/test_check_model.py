"""Laws of the check of a whole model, on rendered walls with exact cameras and pixels."""

from collections.abc import Set

import numpy as np
import pytest
from wall_scene import (
    REFINEMENT,
    Scene,
    big_wall,
    cameras,
    poster,
    repeated,
    scene,
    true_matches,
    twin_matches,
)

from jaxsfm.bench.walls import turn
from jaxsfm.colmap.model import Model
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.check.check_model import (
    MIN_CHECKED_POINTS,
    MIN_VIEWS,
    Checked,
    VerifiedMatches,
    check_model,
)
from jaxsfm.sfm.check.grouping import MAX_CONTRADICTED
from jaxsfm.sfm.check.pose_ambiguity import find_pose_ambiguities

FIRST, OTHERS = [f"{k}.png" for k in range(3)], [f"{k}.png" for k in range(3, 6)]
ANGLES = [-10.0, -4.0, 3.0, -7.0, 0.0, 8.0]
TURNED = turn(np.radians(70))._replace(translation=np.asarray([30.0, 0.0, 5.0]))


def checked(seen: Scene, results: list[PairResult], model: Model | None = None) -> Checked | None:
    matches = {result.pair: result for result in results}
    given = VerifiedMatches(matches, matches.keys(), 0)
    return check_model(model or seen.model, seen.images, given, REFINEMENT)


def second(seen: Scene, results: list[PairResult], against: Set[Pair]) -> list[str]:
    """The photos that have second places."""
    matches = {result.pair: result for result in results}
    given = VerifiedMatches(matches, matches.keys(), 0)
    found = find_pose_ambiguities(seen.model, seen.images, given, REFINEMENT, against)
    return [place.image for place in found]


def of_all_pairs(seen: Scene) -> list[PairResult]:
    count = len(seen.model.views)
    return [true_matches(seen.model, a, b) for a in range(count) for b in range(a + 1, count)]


@pytest.fixture(scope="module")
def right() -> Scene:
    return scene([([big_wall(), poster(1)], cameras(ANGLES))])


def test_a_right_model_is_green_and_explains_its_pairs(right):
    results = of_all_pairs(right)
    found = checked(right, results)
    assert found is not None and found.check.verdict == "green"
    assert found.check.groups == [FIRST + OTHERS] and found.check.pose_ambiguities == []
    assert found.components == found.check.groups
    assert not found.rejected and not found.rejection_candidates and not found.against
    assert found.explained == {result.pair for result in results}


def test_two_walls_that_are_taken_for_one_are_red_and_the_pairs_that_join_them_are_rejected():
    wall = big_wall()
    seen = scene(
        [([wall, poster(1)], cameras(ANGLES[:3])), ([wall, poster(2)], cameras(ANGLES[3:]))]
    )
    results = of_all_pairs(seen)
    found = checked(seen, results)
    assert found is not None and found.check.verdict == "red"
    assert found.check.groups == [FIRST, OTHERS] == found.components
    (told,) = found.check.contradictions
    assert (told.images, told.others) == (FIRST, OTHERS)
    assert MAX_CONTRADICTED * told.tested < told.contradicted < told.tested
    across = {r.pair for r in results if (r.pair[0] in FIRST) != (r.pair[1] in FIRST)}
    assert (
        found.rejected.keys() | found.rejection_candidates.keys() == across
        and len(found.rejected) >= 5
    )
    assert not found.rejected.keys() & found.rejection_candidates.keys()
    assert found.explained == {r.pair for r in results} - across
    for pair, why in found.rejected.items():
        assert ([why.images[0], why.others[0]] == list(pair)) and why.contradicted < why.tested


def test_a_wall_that_is_like_another_gives_second_places_by_the_pairs_that_do_not_agree():
    wall = big_wall()
    seen = scene(
        [
            ([wall], cameras([-8.0, 0.0, 7.0])),
            ([repeated(wall, TURNED)], cameras([-5.0, 2.0, 9.0], motion=TURNED)),
        ]
    )
    false = twin_matches(seen.model, 0, 3, TURNED)
    true = [true_matches(seen.model, 0, 1), true_matches(seen.model, 3, 5)]
    found = checked(seen, [false, *true])
    assert found is not None and not found.check.contradictions and not found.rejected
    assert found.explained == {result.pair for result in true} and found.against == {false.pair}
    assert second(seen, [false, *true], found.against) == ["0.png", "3.png"]
    assert second(seen, true, frozenset()) == []


def test_small_models_are_not_checked(right):
    results = of_all_pairs(right)
    for views in (MIN_VIEWS - 1, MIN_VIEWS):
        part, _ = right.model.part(set((FIRST + OTHERS)[:views]))
        assert (checked(right, results, part) is None) == (views < MIN_VIEWS)
    tracks = right.model.tracks
    for points in (MIN_CHECKED_POINTS - 1, MIN_CHECKED_POINTS):
        few = right.model.with_tracks(tracks.select_points(np.arange(points)))
        assert (checked(right, results, few) is None) == (points < MIN_CHECKED_POINTS)
