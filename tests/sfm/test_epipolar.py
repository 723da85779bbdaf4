"""Robust fundamental matrices: the error's meaning, and what outliers and seeds may change."""

import itertools

import numpy as np
import pytest
from epipolar import two_views
from scipy.optimize import minimize
from strategies import rng_of

from jaxsfm.bench.wxbs import symmetric_epipolar_error
from jaxsfm.sfm.epipolar import (
    fundamental_matrix,
    refine_fundamental_matrix,
    sampson_error,
)


def scattered(rng, n=300):
    """F, exact matches, and the same as they are found: half within a pixel, a third within ten
    pixels, the others anywhere."""
    f, xy0, xy1 = two_views(rng, n=n)
    sigma = np.repeat([0.5, 5.0], [n // 2, n - n // 2])[:, None]
    found = xy1 + rng.normal(size=xy1.shape) * sigma
    found[-n // 6 :] = rng.uniform(0, 600, size=(n // 6, 2))
    return f, xy0, xy1, found


def test_estimators_find_the_geometry_among_outliers_and_repeat():
    rng = rng_of(1)
    f, xy0, xy1 = two_views(rng, n=200)
    noisy = xy1 + rng.normal(size=xy1.shape) * 0.3
    noisy[:80] = rng.uniform(0, 600, size=(80, 2))
    found = fundamental_matrix(xy0, noisy, seed=3)
    assert found is not None
    assert np.median(symmetric_epipolar_error(found, xy0, xy1)) < 0.5
    assert np.array_equal(found, fundamental_matrix(xy0, noisy, seed=3))
    assert fundamental_matrix(xy0[:7], xy1[:7], seed=0) is None


def test_sampson_error_is_the_distance_to_the_nearest_exact_match():
    rng = rng_of(2)
    f, xy0, xy1 = two_views(rng, n=10)
    off = xy1 + rng.normal(size=xy1.shape) * 0.3
    for a, b, error in zip(xy0, off, sampson_error(f, xy0, off), strict=True):
        on_line = {
            "type": "eq",
            "fun": lambda d, a=a, b=b: 1e3 * np.r_[b + d[2:], 1] @ f @ np.r_[a + d[:2], 1],
        }
        nearest = minimize(lambda d: d @ d, np.zeros(4), constraints=on_line, tol=1e-10)
        assert abs(error) == pytest.approx(np.linalg.norm(nearest.x), rel=0.02, abs=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_refinement_returns_to_the_exact_matrix_from_nearby(seed):
    rng = rng_of(seed)
    f, xy0, xy1 = two_views(rng, n=100)
    f = f / np.linalg.norm(f)
    near = f * (1 + 1e-3 * rng.normal(size=(3, 3)))
    refined, cost = refine_fundamental_matrix(near, xy0, xy1)
    assert cost < 1e-6
    assert np.abs(sampson_error(refined, xy0, xy1)).max() < 1e-3
    assert abs(np.linalg.det(refined / np.linalg.norm(refined))) < 1e-12


@pytest.mark.parametrize("seed", range(5))
def test_far_matches_hardly_move_the_refined_matrix(seed):
    f, xy0, xy1, found = scattered(rng_of(seed))
    refined, _ = refine_fundamental_matrix(f, xy0, found)
    clean, _ = refine_fundamental_matrix(f, xy0[:150], found[:150])
    errors = [np.median(symmetric_epipolar_error(m, xy0, xy1)) for m in (refined, clean)]
    assert errors[0] < 2 * errors[1] + 0.1


def test_seeds_agree_where_single_estimates_differ():
    _, xy0, xy1, found = scattered(rng_of(0))
    estimates = [fundamental_matrix(xy0, found, seed=seed) for seed in range(6)]
    errors = [symmetric_epipolar_error(m, xy0, xy1) for m in estimates if m is not None]
    assert len(errors) == 6
    assert max(np.abs(a - b).max() for a, b in itertools.combinations(errors, 2)) < 0.05
