"""Which photos are tried with quarter turns before the mapping."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pair_results import counts

from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import component_of, exhaustive_pairs
from jaxsfm.runs.run_photos import clear_turn, find_turned, groups_stored_alike
from jaxsfm.sfm.limits import UPRIGHT

STRONG, WEAK = counts(UPRIGHT.least_inliers), counts(UPRIGHT.least_inliers - 1)


class Trials:
    """Trials that note what they are asked."""

    def __init__(self, names: Iterable[str] = "abxy", turns: int = 0, only: str = "") -> None:
        self.images = {n: ImageFile(name=n, path=Path(n), size=(4, 3), sha256=n) for n in names}
        self.asked: dict[str, list[str]] = {}
        self.turns, self.only = turns, only

    def turn_of(self, name: str, partners: list[str]) -> int:
        self.asked[name] = partners
        return self.turns if not self.only or name in self.only else 0


@pytest.mark.parametrize(
    ("pair", "found", "asked"),
    [
        (("a", "x"), STRONG, ["y"]),
        (("a", "x"), WEAK, ["x", "y"]),
        (("x", "y"), STRONG, ["x"]),  # both may be stored sideways
    ],
)
def test_a_photo_that_matches_an_upright_one_as_it_is_is_not_tried(pair, found, asked):
    trials: Any = Trials()
    assert find_turned(trials, {("a", "b"): STRONG, pair: found}) == {}
    assert [*trials.asked] == asked
    assert all({*partners} <= {*"ab", *"x"} - {name} for name, partners in trials.asked.items())
    assert all("b" in partners for partners in trials.asked.values())


@pytest.mark.parametrize("only", ["x", "cx", "d"])
def test_a_group_is_turned_if_the_trial_of_one_photo_says_so(only):
    """Photos `c`, `d` and `e` are a group of their own, of which `c` is tried, and `x` is alone."""
    trials: Any = Trials("abcdefgx", turns=1, only=only)
    upright = {("a", "b"): STRONG, ("b", "f"): STRONG, ("f", "g"): STRONG}
    found = find_turned(trials, upright | {("c", "d"): STRONG, ("d", "e"): STRONG})
    turned = {*only} & {"x"} | ({*"cde"} if "c" in only else set())
    assert [*found] == sorted(turned) and [*trials.asked] == [*"cx"]
    assert {image.orientation for image in found.values()} <= {6}
    assert all({*partners} == {*"abfg"} for partners in trials.asked.values())


def test_the_photo_of_a_group_that_is_tried_is_most_like_the_upright_ones():
    trials: Any = Trials("abcdefgx", turns=3)
    upright = {("a", "b"): STRONG, ("b", "f"): STRONG, ("f", "g"): STRONG}
    weak = {("a", "d"): counts(20), ("d", "f"): counts(20), ("a", "e"): counts(30)}
    find_turned(trials, upright | weak | {("c", "d"): STRONG, ("d", "e"): STRONG})
    assert [*trials.asked] == [*"dx"]


@pytest.mark.parametrize(
    ("inliers", "turn"),
    [
        ((1151, 432, 2237, 411), 2),  # photo 16 of temple_sparse_ring, which is upside down
        ((1000, 0, 1499, 0), 0),
        ((0, 1000, 0, 1500), 3),
        ((2000, 0, 1000, 0), 0),
        ((0, UPRIGHT.least_inliers - 1, 0, 0), 0),
        ((0, UPRIGHT.least_inliers, 0, 0), 1),
        ((0, 0, 0, 0), 0),
    ],
)
def test_a_turn_is_clear_with_enough_matches_and_more_than_all_others(inliers, turn):
    assert clear_turn(inliers) == turn


@given(st.lists(st.sampled_from(exhaustive_pairs("abcdefg")), min_size=1))
def test_the_largest_group_is_the_largest_that_strong_pairs_join(strong):
    tried = dict.fromkeys(exhaustive_pairs("abcdefg"), WEAK) | dict.fromkeys(strong, STRONG)
    found, *_ = groups_stored_alike("abcdefg", tried)
    groups = [component_of({name}, strong) for name in "abcdefg"]
    assert found in groups and len(found) == max(map(len, groups))
    # Of equal ones it is the first by name, in whatever order the pairs come.
    assert min(found) == min(min(group) for group in groups if len(group) == len(found))
    assert groups_stored_alike("gfedcba", dict(reversed(tried.items())))[0] == found


@pytest.mark.parametrize(("between", "groups"), [(262, [{*"ab"}, {*"xy"}]), (2000, [{*"abxy"}])])
def test_few_matches_beside_those_of_the_best_pairs_join_no_photos(between, groups):
    """The false pairs of turned photos of Herz-Jesus-P8 have up to 262 beside 2924."""
    tried = {("a", "b"): counts(2924), ("x", "y"): counts(2924), ("b", "x"): counts(between)}
    assert groups_stored_alike("abxy", tried) == groups


def test_without_a_strong_pair_it_is_the_photo_with_most_verified_matches():
    tried = {("a", "b"): counts(10), ("b", "c"): counts(20), ("a", "d"): counts(29)}
    assert groups_stored_alike("dcba", tried)[0] == {"a"}
    assert groups_stored_alike("dcba", {("c", "d"): counts(9)}) == [{"c"}, {"a"}, {"b"}, {"d"}]
    assert groups_stored_alike("ba", {}) == [{"a"}, {"b"}]
