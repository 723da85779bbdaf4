"""Laws of the partners of a row: similar to it, and different from each other."""

import numpy as np
import oracles
import pytest
from compiled import compiled

from jaxsfm.core.retrieval import TIE, partners

chosen = compiled(partners, "k", "candidates", "block")


def units(x) -> np.ndarray:
    x = np.asarray(x, np.float32)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def drawn(n: int, c: int = 12) -> np.ndarray:
    return units(np.maximum(np.random.default_rng(2).normal(size=(n, c)), 0) + 0.01)


@pytest.mark.parametrize("block", [1, 4, 7, 256])
@pytest.mark.parametrize("candidates", [6, 9, 20, 99])
def test_partners_are_those_of_the_whole_table(block, candidates):
    x = drawn(21)
    found = chosen(x, k=6, candidates=candidates, block=block)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, oracles.partners(x, 6, candidates, TIE))


def test_with_k_candidates_the_partners_are_the_nearest():
    x = drawn(21)
    products = x @ x.T - 2 * np.eye(21)
    nearest = np.argsort(-products, axis=1)[:, :5]
    found = chosen(x, k=5, candidates=5)
    np.testing.assert_array_equal(np.sort(found), np.sort(nearest))


def test_a_camera_that_comes_back_is_joined_to_its_first_pass():
    """Two passes along a way, in different light. The nearest frames are all of the same pass."""
    way = np.linspace(0, 1, 30)
    once = np.c_[np.cos(way), np.sin(way), np.full(30, 0.1)]
    both = units(np.r_[once, once * [1, 1, -1]])
    is_first = np.arange(60) < 30
    for candidates, joined in ((4, 0), (20, 60)):
        found = chosen(both, k=4, candidates=candidates)
        assert (is_first[found] != is_first[:, None]).any(1).sum() == joined


def test_of_copies_one_is_taken_before_other_rows():
    """The copies follow when no other row is left."""
    turned = [[np.cos(a), np.sin(a)] for a in (0.0, 0.1, 0.1, 0.1, -0.3, 1.0)]
    found = chosen(units(turned), k=4, candidates=5)
    np.testing.assert_array_equal(found[0], [1, 4, 2, 3])


def test_a_row_that_is_as_near_to_a_partner_as_to_the_row_itself_is_a_partner():
    x = np.eye(4, dtype=np.float32)
    x[3] = [-0.1, -0.2, 0.3, 0]
    x[3, 3] = np.sqrt(1 - (x[3] ** 2).sum())
    found = chosen(x, k=2, candidates=3)
    np.testing.assert_array_equal(found[0], [1, 2])


def test_equally_near_rows_come_in_their_order_and_nothing_is_near_itself():
    x = np.ones((5, 4), np.float32) / 2
    x[3] *= np.float32(1 + 1e-6)  # rounding, no reason
    others = [[j for j in range(5) if j != i] for i in range(5)]
    for candidates in (4, 9):
        found = chosen(x, k=4, candidates=candidates)
        np.testing.assert_array_equal(found, others)
    few = chosen(x, k=2, candidates=4)
    np.testing.assert_array_equal(few, [row[:2] for row in others])


def test_rows_of_one_group_are_no_partners_while_there_are_others():
    """They follow where no others are left."""
    x = drawn(21)
    group = np.arange(21, dtype=np.int32) // 7
    found = chosen(x, k=6, candidates=9, group=group)
    assert (group[found] != group[:, None]).all()
    products = np.where(group != group[:, None], x @ x.T, -9)
    nearest = np.argsort(-products, axis=1)[:, :6]
    np.testing.assert_array_equal(
        np.sort(chosen(x, k=6, candidates=6, group=group)), np.sort(nearest)
    )
    many = chosen(x, k=16, candidates=20, group=group)
    assert ((group[many] != group[:, None]).sum(1) == 14).all()


@pytest.mark.parametrize("k", [0, 3])
def test_more_partners_than_there_are_rows_is_an_error(k):
    with pytest.raises(ValueError, match=f"1..2, .*; got {k}"):
        chosen(np.eye(3, dtype=np.float32), k=k, candidates=5)


def test_fewer_candidates_than_partners_is_an_error():
    with pytest.raises(ValueError, match="at least k = 2; got 1"):
        chosen(np.eye(3, dtype=np.float32), k=2, candidates=1)
