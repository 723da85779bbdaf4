"""Laws of groups of views that agree, and of groups that contradict each other."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from oracles import grouped
from strategies import rng_of, seeds

from jaxsfm.sfm.check.agreement import Agreement
from jaxsfm.sfm.check.grouping import MAX_CONTRADICTED, MIN_TESTED, group_views, share


def counts(views: int, pairs: dict[tuple[int, int], tuple[int, int]]) -> Agreement:
    """Tested points and contradictions, by the view that sees them and the one that should."""
    found = Agreement(np.zeros((views, views), int), np.zeros((views, views), int))
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
    return Agreement(tested, rng.binomial(tested, ratio))


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_views_are_grouped_as_by_a_slow_search_among_sets(seed):
    rng = rng_of(seed)
    views = int(rng.integers(2, 8))
    tested = rng.integers(0, 3000, (views, views)) * (rng.random((views, views)) < 0.7)
    found = Agreement(
        tested, rng.binomial(tested, rng.choice([0.0, 0.02, 0.05, 0.3], tested.shape))
    )
    got = group_views(found)
    want = grouped(found.tested, found.contradicted, MAX_CONTRADICTED, MIN_TESTED)
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
    assert share(*counts(4, pairs))[1, 2] > MAX_CONTRADICTED
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


@pytest.mark.parametrize(("tested", "said"), [(MIN_TESTED - 1, 0), (MIN_TESTED, 1)])
def test_too_few_tests_say_nothing(tested, said):
    """Neither that two views contradict each other, nor that they agree."""
    against = counts(2, {(0, 1): (tested, tested), (1, 0): (1000, 1000)})
    assert len(group_views(against).contradictions) == said
    assert np.isfinite(share(*against)).sum() == 2 * said
    agreeing = counts(2, {(0, 1): (tested, 0), (1, 0): (1000, 0)})
    assert len(group_views(agreeing).groups) == 2 - said


@pytest.mark.parametrize(("contradicted", "groups"), [(30, 1), (31, 2)])
def test_a_share_at_the_limit_still_agrees(contradicted, groups):
    assert contradicted in (1000 * MAX_CONTRADICTED, 1000 * MAX_CONTRADICTED + 1)
    found = counts(2, both_ways({(0, 1): (1000, contradicted)}))
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
