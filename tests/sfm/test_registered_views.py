"""Laws of doubt in places that the refinement has found, on rendered walls."""

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
from jaxsfm.sfm.check.pose_ambiguity import few_points
from jaxsfm.sfm.limits import REGISTER
from jaxsfm.sfm.refine.fixed_structure import FixedStructure
from jaxsfm.sfm.register import grow
from jaxsfm.sfm.register.grow import objections

NEW = 3
NAMES = [f"{k}.png" for k in range(4)]


def placed_before(own: int, others: int) -> Scene:
    """A wall with a poster, seen by three views, and a view that sees another poster there.

    The new view has observations of the wall alone, as alignment gives them.
    """
    wall = big_wall()
    first, second = (
        picture(seed, left=-1.0, width=2.0, height=2.0, z=-0.002) for seed in (others, own)
    )
    seen = scene([([wall, first], cameras([-8.0, 0.0, 7.0])), ([wall, second], cameras([3.0]))])
    tracks = seen.model.tracks
    on_wall = seen.plane == 0
    keep = (tracks.view != NEW) | on_wall[tracks.point]
    return seen._replace(model=seen.model.select(keep))


def whole(seen: Scene) -> FixedStructure:
    return FixedStructure(seen.model, seen.images, REFINEMENT)


def doubted(seen: Scene, *pairs: PairResult, full_size: bool = True) -> dict[str, str]:
    matches = {each.pair: each for each in pairs}
    details = {NAMES[NEW]: full_size}
    return objections(whole(seen), details, matches.keys(), matches)


@pytest.fixture(scope="module")
def right() -> Scene:
    return placed_before(1, 1)


@pytest.fixture(scope="module")
def wrong() -> Scene:
    """The new view shows a copy of the wall, with another poster."""
    return placed_before(2, 1)


def displaced(result: PairResult) -> PairResult:
    return matched(result.pair, result.keypoints0, result.keypoints1 + [60.0, 0.0])


def test_nothing_speaks_against_a_right_place(right):
    assert doubted(right, true_matches(right.model, 2, NEW)) == {}


def test_a_view_that_shows_something_else_is_doubted_by_its_numbers(wrong):
    (name,), (why,) = zip(*doubted(wrong).items(), strict=True)
    assert name == NAMES[NEW]
    tested, contradicted = grow.shown_by(few_points(whole(wrong)), NEW)
    assert f"of {tested} points" in why and why.endswith(f"instead of {contradicted}")
    assert (
        REGISTER.least_contradicted <= contradicted
        and contradicted > REGISTER.contradicted_share * tested
    )
    assert doubted(wrong, full_size=False) == {}  # noise may hide the poster


@pytest.mark.parametrize(
    ("tested", "contradicted", "doubtful"),
    [
        (200, REGISTER.least_contradicted - 1, False),
        (200, REGISTER.least_contradicted, True),
        (400, 59, False),
    ],
)
def test_few_contradictions_are_no_reason_to_doubt(
    right, monkeypatch, tested, contradicted, doubtful
):
    monkeypatch.setattr(grow, "shown_by", lambda *_: (tested, contradicted))
    assert bool(doubted(right)) == doubtful


@pytest.mark.parametrize("full_size", [True, False])
def test_a_neighbour_whose_matches_disagree_is_a_reason_to_doubt(right, full_size):
    """At night too."""
    away = displaced(true_matches(right.model, 2, NEW))
    found = doubted(right, true_matches(right.model, 1, NEW), away, full_size=full_size)
    assert (
        found.keys() == {NAMES[NEW]} and f"its neighbour {NAMES[2]} do not agree" in found["3.png"]
    )


def test_pairs_of_other_photos_say_nothing_about_a_new_one(right):
    assert doubted(right, displaced(true_matches(right.model, 0, 1))) == {}
