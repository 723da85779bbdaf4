"""How probable it is that a model is wrong, and which pairs alone join groups of photos."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsfm.io.pairs import component_of, make_pair
from jaxsfm.sfm.check.agreement import Agreement
from jaxsfm.sfm.check.grouping import MAX_CONTRADICTED, DoubtCurve, disagreement, group_views
from jaxsfm.sfm.view_graph import bridges

CURVE = DoubtCurve(half=0.05, power=2.5, most=0.2)


def two_groups(share: float, *, undecided: int = 0) -> Agreement:
    """Two views and two more: within a pair nothing contradicts, between the pairs a share does."""
    tested = np.full((4, 4), 1000) - 1000 * np.eye(4, dtype=int)
    contradicted = np.zeros((4, 4), int)
    contradicted[:2, 2:] = contradicted[2:, :2] = round(1000 * share)
    return Agreement(tested, contradicted, np.where(contradicted > 0, undecided, 0))


def test_views_that_never_contradict_each_other_do_not_disagree():
    assert disagreement(two_groups(0.0)) == 0.0


@pytest.mark.parametrize("share", [0.001, 0.02, 0.03, 0.2, 0.7])
def test_the_disagreement_is_the_share_at_which_the_last_groups_are_joined(share):
    assert disagreement(two_groups(share)) == pytest.approx(share)


def test_what_the_light_explains_is_no_disagreement():
    assert disagreement(two_groups(0.03, undecided=20)) == 0.0


def test_one_direction_alone_is_no_disagreement():
    found = two_groups(0.2)
    found.contradicted[:2, 2:] = 0
    assert disagreement(found) == 0.0


@given(st.integers(0, 2**32 - 1))
def test_groups_are_left_over_if_and_only_if_the_disagreement_is_above_the_limit(seed):
    rng = np.random.default_rng(seed)
    tested = np.full((5, 5), 400)
    contradicted = rng.integers(0, 40, (5, 5)) * rng.integers(0, 2, (5, 5))
    found = Agreement(tested, contradicted, np.zeros((5, 5), int))
    whole = len(group_views(found).groups) == 1
    assert whole == (disagreement(found) <= MAX_CONTRADICTED)


def test_a_model_without_disagreement_is_not_wrong():
    assert CURVE.probability(0.0) == 0.0


def test_the_curve_passes_one_half_and_grows():
    assert CURVE.probability(CURVE.half) == pytest.approx(0.5)
    found = [CURVE.probability(share) for share in np.geomspace(1e-4, 1, 50)]
    assert all(a < b for a, b in zip(found, found[1:], strict=False))
    assert 0 < found[0] and found[-1] < 1


def test_the_limit_of_the_disagreement_has_the_limit_of_the_probability():
    assert CURVE.probability(CURVE.most_contradicted()) == pytest.approx(CURVE.most)


@given(st.sets(st.tuples(st.integers(0, 8), st.integers(0, 8)), max_size=16))
def test_a_bridge_is_a_pair_without_which_its_photos_are_in_two_groups(rows):
    pairs = sorted({make_pair(f"{a}", f"{b}") for a, b in rows if a != b})

    def alone(pair):
        return pair[1] not in component_of({pair[0]}, [p for p in pairs if p != pair])

    assert bridges(pairs) == [pair for pair in pairs if alone(pair)]
