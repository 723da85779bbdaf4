"""Laws of groups of views that agree, and of groups that contradict each other."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from oracles import grouped
from strategies import rng_of, seeds

from jaxsfm.sfm.check.agreement import Agreement
from jaxsfm.sfm.check.grouping import (
    MAX_CONTRADICTED,
    Grouping,
    OpposedGroups,
    consistent_components,
    group_views,
    share,
)
from jaxsfm.sfm.limits import CHECK


def counts(views: int, pairs: dict[tuple[int, int], tuple[int, int]]) -> Agreement:
    """Tested points and contradictions, by the view that sees them and the one that should."""
    found = Agreement(*(np.zeros((views, views), int) for _ in range(3)))
    for pair, (tested, contradicted) in pairs.items():
        found.tested[pair], found.contradicted[pair] = tested, contradicted
    return found


def both_ways(pairs: dict[tuple[int, int], tuple[int, int]]) -> dict:
    return pairs | {(b, a): each for (a, b), each in pairs.items()}


def blocks(rng: np.random.Generator, sizes: list[int], contradicted: float) -> Agreement:
    """Views in blocks: contradictions within one are rare, and this share of the points between
    them. No two pairs of views have the same counts."""
    block = np.repeat(np.arange(len(sizes)), sizes)
    tested = rng.integers(200, 5000, (len(block), len(block)))
    np.fill_diagonal(tested, 0)
    ratio = np.where(block[:, None] == block, 0.005, contradicted)
    return Agreement(tested, rng.binomial(tested, ratio), np.zeros_like(tested))


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_views_are_grouped_as_by_a_slow_search_among_sets(seed):
    rng = rng_of(seed)
    views = int(rng.integers(2, 8))
    tested = rng.integers(0, 3000, (views, views)) * (rng.random((views, views)) < 0.7)
    contradicted = rng.binomial(tested, rng.choice([0.0, 0.02, 0.05, 0.3], tested.shape))
    undecided = rng.integers(0, 40, tested.shape)
    found = Agreement(tested, contradicted, undecided)
    got = group_views(found)
    want = grouped(tested, contradicted, undecided, MAX_CONTRADICTED, CHECK.least_tested)
    assert [set(group) for group in got.groups] == want[0]
    said = {
        frozenset(map(frozenset, c.groups)): (c.tested, c.contradicted) for c in got.contradictions
    }
    assert said == want[1] and len(said) == len(got.contradictions)


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_the_order_of_views_has_no_effect(seed):
    rng = rng_of(seed)
    found = blocks(rng, list(rng.integers(1, 4, 3)), rng.choice([0.02, 0.035, 0.2]))
    order = rng.permutation(len(found.tested))
    moved = Agreement(*(each[np.ix_(order, order)] for each in found))
    one, other = group_views(found), group_views(moved)
    back = [sorted(order[group].tolist()) for group in other.groups]
    assert sorted(back) == sorted(one.groups)
    assert sorted(c[1:] for c in one.contradictions) == sorted(c[1:] for c in other.contradictions)


def test_views_that_agree_are_one_group():
    got = group_views(blocks(rng_of(0), [6], 0.0))
    assert got.groups == [list(range(6))] and got.contradictions == []


def test_two_blocks_that_contradict_each_other_stay_apart_and_are_told_by_the_better_direction():
    """Of the points of the larger block 30 % are contradicted, of those of the smaller one 8 %."""
    pairs = both_ways(
        {p: (500, 1) for p in itertools.combinations(range(3), 2)} | {(3, 4): (500, 1)}
    )
    for a, b in itertools.product(range(3), (3, 4)):
        pairs |= {(a, b): (200, 60), (b, a): (100, 8)}
    got = group_views(counts(5, pairs))
    assert got.groups == [[0, 1, 2], [3, 4]]
    (told,) = got.contradictions
    assert told == (([0, 1, 2], [3, 4]), 6 * 100, 6 * 8)


def test_groups_are_joined_by_what_all_their_views_say_together():
    """One pair of views has more than the limit by bad luck; the others outvote it."""
    pairs = both_ways({p: (1000, 2) for p in ((0, 1), (2, 3), (0, 2), (1, 3), (0, 3))})
    pairs |= both_ways({(1, 2): (100, 8)})
    found = counts(4, pairs)
    assert share(found.tested, found.beyond_light())[1, 2] > MAX_CONTRADICTED
    assert group_views(counts(4, pairs)).groups == [[0, 1, 2, 3]]


def test_a_passer_by_who_hides_points_in_one_photo_contradicts_nobody():
    """Half of what others see is missing in his photo. He is in no other photo, so nothing that his
    photo shows is missing there."""
    pairs = both_ways({(0, 1): (400, 0)})
    pairs |= {(k, 2): (400, 200) for k in (0, 1)} | {(2, k): (200, 0) for k in (0, 1)}
    got = group_views(counts(3, pairs))
    assert got.groups == [[0, 1, 2]] and got.contradictions == []
    pairs |= {(2, k): (400, 200) for k in (0, 1)}  # but a photo of another place stays alone
    assert group_views(counts(3, pairs)).groups == [[0, 1], [2]]


@pytest.mark.parametrize(("tested", "said"), [(CHECK.least_tested - 1, 0), (CHECK.least_tested, 1)])
def test_too_few_tests_say_nothing(tested, said):
    """Neither that two views contradict each other, nor that they agree."""
    against = counts(2, {(0, 1): (tested, tested), (1, 0): (1000, 1000)})
    assert len(group_views(against).contradictions) == said
    assert np.isfinite(share(against.tested, against.beyond_light())).sum() == 2 * said
    agreeing = counts(2, {(0, 1): (tested, 0), (1, 0): (1000, 0)})
    assert len(group_views(agreeing).groups) == 2 - said


@pytest.mark.parametrize(("more", "groups"), [(0, 1), (1, 2)])
def test_a_share_at_the_limit_still_agrees(more, groups):
    most = math.floor(10**6 * MAX_CONTRADICTED)
    found = counts(2, both_ways({(0, 1): (10**6, most + more)}))
    assert len(group_views(found).groups) == groups


def test_a_chain_of_agreeing_views_is_one_group_though_its_ends_share_nothing():
    pairs = both_ways({(k, k + 1): (300, 0) for k in range(7)})
    assert group_views(counts(8, pairs)).groups == [list(range(8))]


def test_groups_that_share_nothing_do_not_contradict_each_other():
    got = group_views(counts(5, both_ways({(0, 1): (300, 0), (2, 3): (300, 0), (3, 4): (300, 0)})))
    assert got.groups == [[2, 3, 4], [0, 1]] and got.contradictions == []


def test_what_agrees_most_surely_is_joined_first():
    """A view between two others that contradict each other goes to the one that says more."""
    pairs = both_ways({(0, 2): (100, 0), (1, 2): (1000, 0), (0, 1): (500, 100)})
    got = group_views(counts(3, pairs))
    assert got.groups == [[1, 2], [0]]
    assert got.contradictions[0][1:] == (600, 100)


def observed(points: dict[tuple[int, ...], int]) -> tuple[np.ndarray, np.ndarray]:
    """Observations of so many points by these views each."""
    view, point, count = [], [], 0
    for views, many in points.items():
        for _ in range(many):
            view += views
            point += [count] * len(views)
            count += 1
    return np.asarray(view, int), np.asarray(point, int)


def opposing(groups: list[list[int]], *pairs: tuple[int, int]) -> Grouping:
    return Grouping(groups, [OpposedGroups((groups[a], groups[b]), 100, 50) for a, b in pairs])


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_no_part_holds_groups_that_contradict_each_other_and_none_could_be_joined(seed):
    """The order of the groups has no effect."""
    rng = rng_of(seed)
    sizes = rng.integers(1, 4, int(rng.integers(1, 7)))
    views = rng.permutation(int(sizes.sum()))
    groups = [sorted(each.tolist()) for each in np.split(views, np.cumsum(sizes)[:-1])]
    pairs = list(itertools.combinations(range(len(groups)), 2))
    against = [pair for pair in pairs if rng.random() < 0.4]
    # All sums of these are different, so what is joined first is certain.
    shared = {pair: 2 ** int(k) for pair, k in zip(pairs, rng.permutation(len(pairs)), strict=True)}
    seen = observed({(groups[a][0], groups[b][-1]): n for (a, b), n in shared.items()})
    found = consistent_components(opposing(groups, *against), *seen)
    assert sorted(v for part in found for v in part) == list(range(len(views)))
    part_of = {v: k for k, part in enumerate(found) for v in part}
    where = [{part_of[v] for v in group} for group in groups]
    assert all(len(each) == 1 for each in where)
    assert all(where[a] != where[b] for a, b in against)
    at = [min(each) for each in where]
    for one, other in itertools.combinations(range(len(found)), 2):
        between = [(a, b) for a, b in pairs if {at[a], at[b]} == {one, other}]
        opposed = any(pair in against for pair in between)
        assert opposed or sum(shared[pair] for pair in between) < CHECK.least_shared
    order = rng.permutation(len(groups)).tolist()
    place = {old: new for new, old in enumerate(order)}
    turned = opposing([groups[k] for k in order], *((place[a], place[b]) for a, b in against))
    assert consistent_components(turned, *seen) == found
    assert [len(part) for part in found] == sorted(map(len, found), reverse=True)


@pytest.mark.parametrize(
    ("shared", "count"), [(CHECK.least_shared - 1, 3), (CHECK.least_shared, 2)]
)
def test_a_group_goes_with_the_one_that_it_shares_points_with(shared, count):
    """Group 2 contradicts nobody; groups 0 and 1 share more, but contradict each other."""
    groups = [[0, 1], [2, 3], [4]]
    seen = observed({(0, 2): 500, (3, 4): shared, (1, 4): 10})
    assert len(consistent_components(opposing(groups, (0, 1)), *seen)) == count


def test_points_that_several_views_of_a_group_see_count_once():
    seen = observed({(0, 1, 2, 3): CHECK.least_shared - 1})
    assert len(consistent_components(opposing([[0, 1], [2, 3]]), *seen)) == 2


def test_a_group_joins_no_part_that_holds_what_it_contradicts():
    """Groups 0 and 1 share most and are joined; group 2 contradicts 1, so it cannot join 0."""
    seen = observed({(0, 1): 500, (0, 2): 400, (1, 2): 300})
    assert consistent_components(opposing([[0], [1], [2]], (1, 2)), *seen) == [[0, 1], [2]]
