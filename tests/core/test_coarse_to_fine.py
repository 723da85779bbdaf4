"""Laws of the windowed coarse-to-fine step and of one-to-one selection."""

import numpy as np
import oracles
import pytest
import tolerances
from compiled import compiled
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import rng_of, seeds, unit_rows

from jaxsfm.core import coarse_to_fine as c2f
from jaxsfm.core.types import JoinedFeatures

match_windows = compiled(c2f.match_windows, "chunk")
correspondences = compiled(c2f.correspondences, "capacity")
candidates = compiled(c2f.candidates)
similarities = compiled(c2f.similarities, "chunk")
one_to_one = compiled(c2f.one_to_one, "num_cells")
GRIDS = [((4, 5), (8, 10)), ((4, 5), (9, 11)), ((3, 3), (6, 7)), ((5, 4), (10, 9))]
N, M = 24, 128


def features(rng, coarse_grid, fine_grid) -> JoinedFeatures:
    fine = np.zeros((M, 8), np.float32)
    used = fine_grid[0] * fine_grid[1]
    fine[:used] = unit_rows(rng, used, 8)
    fine[rng.integers(0, used)] = 0  # a cell where nothing is seen
    return JoinedFeatures(
        coarse=np.zeros((N, 8), np.float32),
        fine=fine,
        keypoints=np.zeros((M, 2), np.float32),
        coarse_grid=np.int32(coarse_grid),
        fine_grid=np.int32(fine_grid),
    )


def problem(seed, grids0, grids1):
    rng = rng_of(seed)
    f0, f1 = features(rng, *grids0), features(rng, *grids1)
    n0, n1 = np.prod(grids0[0]), np.prod(grids1[0])
    coarse = np.full(N, -1, np.int32)
    rows, cols = rng.permutation(n0), rng.permutation(n1)
    k = min(n0, n1) // 2
    coarse[rows[:k]] = cols[:k]
    return f0, f1, coarse


@compiled
def run(f0, f1, coarse):
    table = c2f.candidates(c2f.match_windows(f0, f1, coarse, chunk=5), f0)
    return c2f.correspondences(table, capacity=1024)


def as_list(f0, f1, coarse):
    cells, count = run(f0, f1, coarse)
    return [tuple(row) for row in cells[:count].tolist()]


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from(GRIDS), st.sampled_from(GRIDS))
def test_the_correspondences_are_those_of_a_plain_loop(seed, grids0, grids1):
    f0, f1, coarse = problem(seed, grids0, grids1)
    expected = oracles.coarse_to_fine(
        coarse, f0.fine, f1.fine, *grids0[:1], *grids1[:1], grids0[1], grids1[1],
    )  # fmt: skip
    ours = as_list(f0, f1, coarse)
    assert set(ours) == expected
    assert ours == sorted(set(ours))  # each once, in index order


def test_swapping_the_images_swaps_the_correspondences():
    f0, f1, coarse = problem(3, GRIDS[0], GRIDS[2])
    back = np.full(N, -1, np.int32)
    for i, j in enumerate(coarse):
        if j >= 0:
            back[j] = i
    swapped = {(j, i) for i, j in as_list(f1, f0, back)}
    assert swapped == set(as_list(f0, f1, coarse))


def test_odd_last_rows_and_columns_are_never_matched():
    f0, f1, coarse = problem(1, GRIDS[1], GRIDS[1])
    for i, j in as_list(f0, f1, coarse):
        for cell in (i, j):
            row, col = divmod(cell, 11)
            assert row < 8 and col < 10


def test_no_coarse_matches_give_nothing():
    f0, f1, coarse = problem(0, GRIDS[0], GRIDS[0])
    assert as_list(f0, f1, np.full_like(coarse, -1)) == []


def test_a_full_list_is_cut_and_says_so():
    f0, f1, coarse = problem(0, GRIDS[0], GRIDS[0])
    table = candidates(match_windows(f0, f1, coarse), f0)
    cells, count = correspondences(table, capacity=10)
    assert count > 10
    np.testing.assert_array_equal(cells, correspondences(table, capacity=1024)[0][:10])


@pytest.mark.parametrize("chunk", [1, 7, 24])
def test_the_chunk_size_changes_nothing(chunk):
    f0, f1, coarse = problem(5, GRIDS[0], GRIDS[1])
    np.testing.assert_array_equal(
        match_windows(f0, f1, coarse, chunk=chunk), match_windows(f0, f1, coarse, chunk=5)
    )


def test_the_last_chunk_holds_the_last_matches():
    """Every cell is matched, so that the chunks end where the list does, or past it."""
    f0, f1, coarse = problem(5, GRIDS[0], GRIDS[0])
    coarse = np.arange(len(coarse), dtype=np.int32) % 6
    whole = match_windows(f0, f1, coarse, chunk=len(coarse))
    for chunk in (5, 7, len(coarse) - 1):
        np.testing.assert_array_equal(match_windows(f0, f1, coarse, chunk=chunk), whole)


@pytest.mark.parametrize("found", [0, 1, 7, 8, 61, 100])
def test_similarities_are_products_as_far_as_there_are_correspondences(found):
    f0, f1, _ = problem(5, GRIDS[0], GRIDS[2])
    cells = np.int32(rng_of(0).integers(0, 48, (61, 2)))
    ours = similarities(f0, f1, cells, np.int32(found), chunk=8)
    expected = (f0.fine[cells[:, 0]] * f1.fine[cells[:, 1]]).sum(1)
    np.testing.assert_allclose(ours[:found], expected[:found], **tolerances.UNIT)


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_one_to_one_keeps_no_cell_twice_and_wastes_none(seed):
    rng = rng_of(seed)
    cells = rng.integers(0, 12, (30, 2)).astype(np.int32)
    keep = rng.random(30) < 0.7
    score = rng.integers(0, 3, 30).astype(np.float32)
    ours = one_to_one(cells, keep, score, num_cells=12)
    assert not (ours & ~keep).any()
    for side in (0, 1):
        assert len(set(cells[ours, side])) == ours.sum()
    np.testing.assert_array_equal(ours, oracles.one_to_one(cells, keep, score))
    # The best of a cell of image 0 loses only to one at least as good in image 1.
    for i in np.flatnonzero(keep & ~ours):
        rivals = keep & ((cells[:, 0] == cells[i, 0]) | (cells[:, 1] == cells[i, 1]))
        assert (score[rivals] >= score[i]).sum() > 1


def test_one_to_one_with_equal_scores_keeps_the_first():
    cells = np.int32([[0, 1], [0, 2], [1, 1], [2, 2]])
    ours = one_to_one(cells, np.ones(4, bool), np.zeros(4, np.float32), num_cells=3)
    # (0, 1) is first for cell 0 and for cell 1 of image 1; (0, 2) has gone, so (2, 2) stays.
    np.testing.assert_array_equal(ours, [True, False, False, True])
