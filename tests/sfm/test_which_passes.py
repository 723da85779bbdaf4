"""Laws of the order of looks: what significance settles a pair, and which looks follow
otherwise."""

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxsfm.config import preset
from jaxsfm.sfm.refine.pair_alignment import AlignedMatches
from jaxsfm.sfm.two_photos import pair_passes
from jaxsfm.sfm.two_photos.further_passes import PlanePasses
from jaxsfm.sfm.two_photos.matching_pass import PhotoPair
from jaxsfm.sfm.two_photos.rectification import Located


def aligned(each: Any) -> AlignedMatches:
    """One match of a pass, where its significance is."""
    return AlignedMatches(np.asarray([[each.significance, 0.0]]), np.asarray([True]))


FEATURES: Any = SimpleNamespace(image="photo")


def fake(significance: float, inliers: int = 0, tentative: int = 0) -> Any:
    """A pass with this significance, which is where the next one looks."""
    counts = SimpleNamespace(num_inliers=inliers, num_tentative=tentative)
    return SimpleNamespace(
        significance=significance, result=counts, located=lambda *_: significance
    )


@pytest.mark.parametrize(
    ("significance", "share", "conclusive"),
    [
        (401, 0.01, True),
        (399, 0.01, False),
        (61, 0.21, True),
        (61, 0.19, False),
        (59, 0.9, False),
    ],
)
def test_a_pair_is_conclusive_by_significance_or_by_a_large_share_that_is_likely_right(
    significance, share, conclusive
):
    assert (
        pair_passes.is_conclusive(fake(significance, inliers=round(1000 * share), tentative=1000))
        == conclusive
    )


def test_a_pair_without_matches_is_not_conclusive():
    assert not pair_passes.is_conclusive(fake(0.0))


def seen_as(matrix: list[list[float]]) -> Any:
    """A strong look at two photos of which one is the other after a 2 x 2 map."""
    xy0 = np.random.default_rng(0).uniform(0, 400, (50, 2))
    both = Located(xy0, xy0 @ np.asarray(matrix).T)
    counts = SimpleNamespace(num_inliers=500, num_tentative=1000)
    return SimpleNamespace(significance=1900.0, result=counts, located=lambda *_: both)


def turn(degrees: float) -> list[list[float]]:
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return [[cos, -sin], [sin, cos]]


UNLIKE = [
    ([[1.51, 0], [0, 1.51]], True),
    ([[1.49, 0], [0, 1.49]], False),
    ([[1 / 1.51, 0], [0, 1 / 1.51]], True),
    ([[1 / 1.49, 0], [0, 1 / 1.49]], False),
    ([[1, 0], [0, 0.65]], True),
    ([[1, 0], [0, 0.68]], False),
    (turn(16), True),
    (turn(-14), False),
]


@pytest.mark.parametrize(("matrix", "unlike"), UNLIKE)
def test_a_strong_pair_is_matched_once_more_if_its_photos_show_it_differently(
    monkeypatch, matrix, unlike
):
    asked: list[int] = []

    def closer(*_, size: int, **__: object) -> Any:
        asked.append(size)
        return SimpleNamespace(significance=2000.0, result=None)

    features: Any = SimpleNamespace(image="photo")
    weights: Any = None
    monkeypatch.setattr(pair_passes, "match_once", lambda *_, **__: seen_as(matrix))
    monkeypatch.setattr(pair_passes, "match_rectified", closer)
    monkeypatch.setattr(pair_passes, "_aligned", lambda each, *_: aligned(each))
    monkeypatch.setattr(pair_passes, "as_one", lambda results: results)
    found = pair_passes.match_photos(weights, features, features, config=preset("default"))
    assert asked == [pair_passes.SIZE] * unlike  # at most once, however much it brings
    assert found.significance == (2000.0 if unlike else 1900.0)
    once = dataclasses.replace(preset("default"), max_rectified_planes=0)
    assert pair_passes.match_photos(weights, features, features, config=once).passes == 1


@pytest.mark.parametrize(("share", "counts"), [(0.51, True), (0.49, False)])
def test_a_view_from_one_place_counts_if_it_confirms_the_first_pass(monkeypatch, share, counts):
    features: Any = SimpleNamespace(image="photo")
    weights: Any = None
    seen = SimpleNamespace(significance=share * 1900.0, result=None)
    monkeypatch.setattr(pair_passes, "match_once", lambda *_, **__: seen_as(turn(90)))
    monkeypatch.setattr(pair_passes, "match_rectified", lambda *_, **__: seen)
    monkeypatch.setattr(pair_passes, "_aligned", lambda each, *_: aligned(each))
    monkeypatch.setattr(pair_passes, "as_one", lambda results: results)
    found = pair_passes.match_photos(weights, features, features, config=preset("default"))
    assert found.significance == (seen.significance if counts else 1900.0)


def test_photos_whose_matches_show_no_view_are_not_matched_once_more():
    photos: Any = ("photo", "photo")
    assert pair_passes.seen_alike(seen_as([[-1, 0], [0, 1]]), photos)  # a mirrored photo


@pytest.mark.parametrize(
    ("first", "best", "planes", "expected"),
    [
        (1.0, 14.9, [99.0], (14.9, 2, False)),  # without hope, nothing is looked at
        (1.0, 15.0, [], (15.0, 7, False)),
        (1.0, 300.0, [200.0, 150.0], (200.0, 7, True)),
        (1.0, 1300.0, [1400.0], (1400.0, 7, True)),
        (999.0, 999.0, [1400.0], (1400.0, 6, True)),  # conclusive, and not searched any further
        (1000.0, 1000.0, [1400.0], (1000.0, 1, False)),  # matched well as it is
    ],
)
def test_the_planes_of_the_best_pass_give_the_matches_if_they_are_confirmed(
    monkeypatch, first, best, planes, expected
):
    features: Any = SimpleNamespace(image="photo")
    weights: Any = None
    asked: list[float] = []

    def match_planes_rectified(_, whole: Any) -> list[Any]:
        asked.append(whole.significance)
        return PlanePasses([fake(each) for each in planes], 5)

    monkeypatch.setattr(pair_passes, "match_once", lambda *_, **__: fake(first))
    monkeypatch.setattr(pair_passes, "at_other_scales", lambda *_, **__: [])
    monkeypatch.setattr(
        pair_passes, "_search_further", lambda *given, **__: [*given[2], fake(best)]
    )
    monkeypatch.setattr(pair_passes, "match_planes_rectified", match_planes_rectified)
    monkeypatch.setattr(pair_passes, "_aligned", lambda each, *_: aligned(each))
    monkeypatch.setattr(pair_passes, "as_one", lambda results: len(results))
    monkeypatch.setattr(pair_passes, "seen_alike", lambda *_: True)
    found = pair_passes.match_photos(weights, features, features, config=preset("default"))
    significance, looks, confirmed = expected
    assert (found.significance, found.passes) == (significance, looks)
    assert found.result == (len(planes) if confirmed else 1)
    shown = planes if confirmed else [best]
    assert found.aligned.keypoints1[:, 0].tolist() == shown
    assert asked == [best] * (best not in (14.9, 1000.0))


@pytest.mark.parametrize(
    ("significance", "share", "strong"),
    [(1000.0, 0.01, True), (999.0, 0.49, False), (61.0, 0.51, True), (59.0, 0.9, False)],
)
def test_a_pair_is_strong_by_its_significance_or_by_most_of_its_matches(
    significance, share, strong
):
    """A small photo has too few cells for much significance."""
    first = fake(significance, inliers=round(1000 * share), tentative=1000)
    assert pair_passes.is_strong(first) == strong


@pytest.mark.parametrize("planes", [[], [1400.0]])
def test_photos_seen_differently_are_seen_from_one_place_if_no_plane_is_confirmed(
    monkeypatch, planes
):
    features: Any = SimpleNamespace(image="photo")
    weights: Any = None
    first = seen_as(turn(90))
    first.significance, first.result = 600.0, SimpleNamespace(num_inliers=100, num_tentative=1000)
    found = PlanePasses([fake(each) for each in planes], 3)
    monkeypatch.setattr(pair_passes, "match_once", lambda *_, **__: first)
    monkeypatch.setattr(pair_passes, "match_planes_rectified", lambda *_, **__: found)
    monkeypatch.setattr(pair_passes, "match_rectified", lambda *_, **__: fake(301.0))
    monkeypatch.setattr(pair_passes, "_aligned", lambda each, *_: aligned(each))
    monkeypatch.setattr(pair_passes, "as_one", lambda results: results)
    pair = pair_passes.match_photos(weights, features, features, config=preset("default"))
    assert (pair.significance, pair.passes) == ((1400.0, 4) if planes else (301.0, 5))


@pytest.fixture
def steps(monkeypatch):
    """The looks that are taken, by name; all of them find what `found` says, or nothing."""
    found: dict[str, list[float]] = {}
    log: list[str] = []

    def taken(name: str) -> list[Any]:
        log.append(name)
        return [fake(found[name].pop(0))] if found.get(name) else []

    def one(name: str) -> Any:
        return (taken(name) or [fake(0.0)])[0]

    def closer(_, located: object, *, size: int) -> Any:
        assert size == pair_passes.SMALL_SIZE
        return (taken("proposed") or [None])[0]

    monkeypatch.setattr(pair_passes, "image_features", lambda *_, **__: FEATURES)
    monkeypatch.setattr(pair_passes, "match_once", lambda *_, **__: one("enlarged"))
    monkeypatch.setattr(pair_passes, "at_other_scales", lambda *_, **__: taken("scales"))
    monkeypatch.setattr(pair_passes, "turned", lambda *_, **__: taken("turned"))
    monkeypatch.setattr(pair_passes, "proposals", lambda *_: ["a proposal"])
    monkeypatch.setattr(pair_passes, "match_rectified", closer)

    def looks(first: float, name: str = "default", **finds: list[float]) -> list[str]:
        log.clear()
        found.clear()
        found.update(finds)
        weights: Any = None
        photos: Any = ("photo", "photo")
        pair = PhotoPair(photos, weights, preset(name), 0)
        pair_passes._search_further(pair, (FEATURES, FEATURES), [fake(first)])
        return list(log)

    return looks


def test_a_pass_that_is_sure_ends_the_search_at_once(steps):
    assert steps(151) == []
    assert steps(149)[:3] == ["enlarged", "scales", "proposed"]


def test_what_makes_a_pair_sure_ends_the_search(steps):
    assert steps(60, enlarged=[151]) == ["enlarged", "scales"]
    assert "proposed" in steps(60, enlarged=[149])


def test_photos_that_are_enlarged_already_are_not_enlarged_again(steps):
    assert steps(60, name="robust")[0] == "proposed"


def test_photos_are_turned_unless_a_pass_is_sure(steps):
    assert "turned" in steps(20, proposed=[149])
    assert "turned" not in steps(20, proposed=[151])


def test_confidence_is_half_at_the_significance_of_a_pair_that_may_be_right_or_wrong():
    half, power = pair_passes.HALF_SURE, pair_passes.POWER
    assert pair_passes.confidence(half) == pytest.approx(0.5)
    odds = [c / (1 - c) for c in map(pair_passes.confidence, (half / 2, half, 3 * half))]
    assert odds == pytest.approx([0.5**power, 1.0, 3.0**power])
    assert pair_passes.confidence(0.0) == pair_passes.confidence(1.0) < 1e-3
