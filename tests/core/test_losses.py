"""Laws of the losses of relocalizers."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tolerances
from compiled import compiled
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import rng_of, seeds

from jaxsfm.core import losses
from jaxsfm.core import relocalize as walks
from jaxsfm.core.relocalize import WalkProbabilities
from jaxsfm.sfm.epipolar import sampson_error

# Numbers of Python are checked to be such, and then each would have a program of its own. Without
# the check they are traced.
agreement, mean_distance = (
    compiled(inspect.unwrap(f)) for f in (losses.agreement, losses.mean_distance)
)
transfer_distances = compiled(losses.transfer_distances)
epipolar_distances = compiled(losses.epipolar_distances)
sampson_distances, peakiness = compiled(losses.sampson_distances), compiled(losses.peakiness)
cells_under_homography = compiled(losses.cells_under_homography, "rows", "cols")
share_within = compiled(losses.share_within, "px")
weighted_mean = compiled(losses.weighted_mean)
walk, window_positions = compiled(walks.walk), compiled(walks.window_positions)
IDENTITY = np.eye(3, dtype=np.float32)


def random_walks(seed: int, *, cells: int = 5, temperature: float = 1.0) -> WalkProbabilities:
    rng = rng_of(seed)
    scores = [np.float32(rng.gamma(1.0, size=(6 * 2**k, 6 * 2**k))) for k in (1, 2)]
    row, col = (np.int32(rng.integers(0, 6, cells)) for _ in range(2))
    return walk(scores, row, col, temperature=temperature)


def certain(xy: list[tuple[int, int]]) -> WalkProbabilities:
    """Walks that end at given pixels for certain, in windows of 2 x 2."""
    at = np.asarray(xy)
    p = np.zeros((len(xy), 2, 2), np.float32)
    p[np.arange(len(xy)), at[:, 1] % 2, at[:, 0] % 2] = 1
    return WalkProbabilities(p, np.int32(at - at % 2))


def random_homography(seed: int) -> np.ndarray:
    rng = rng_of(seed)
    h = np.eye(3) + np.r_[rng.normal(size=6) * [0.2, 0.2, 5, 0.2, 0.2, 5], 0, 0, 0].reshape(3, 3)
    h[2, :2] = rng.normal(size=2) * 1e-3
    return h


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(seeds, st.floats(0.3, 5.0))
def test_agreement_is_the_probability_that_drawn_walks_agree(seed, sigma):
    """Against the double sum over all ends, in float64."""
    first, second = random_walks(seed), random_walks(seed + 1)
    h = random_homography(seed)
    squared = transfer_distances(np.float32(h), first, second)
    ours = agreement(first, second, squared, sigma=sigma)
    a, b = (np.asarray(window_positions(w), np.float64) for w in (first, second))
    p, q = (np.asarray(w.p, np.float64).reshape(len(w.p), -1) for w in (first, second))
    for m in range(len(a)):
        total = 0.0
        for i in range(a.shape[1]):
            moved = h @ [*a[m, i], 1.0]
            apart = np.sum((moved[:2] / moved[2] - b[m]) ** 2, axis=1)
            total += p[m, i] * float(np.exp(-0.5 * apart / sigma**2) @ q[m])
        assert abs(float(ours[m]) - total) < 1e-4
    assert float(ours.min()) >= 0 and float(ours.max()) <= 1 + 1e-5


def test_certain_walks_agree_by_their_distance_alone():
    first, second = certain([(4, 6), (4, 6), (10, 3)]), certain([(4, 6), (7, 6), (10, 5)])
    squared = transfer_distances(IDENTITY, first, second)
    found = agreement(first, second, squared, sigma=2.0)
    np.testing.assert_allclose(found, np.exp([0, -9 / 8, -4 / 8]), **tolerances.UNIT)
    np.testing.assert_allclose(
        mean_distance(first, second, squared, most=2.5), [1e-3, 2.5, 2.0], atol=1e-3
    )


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_agreement_does_not_depend_on_which_view_is_first(seed):
    first, second = random_walks(seed), random_walks(seed + 1)
    there = agreement(first, second, transfer_distances(IDENTITY, first, second), sigma=1.0)
    back = agreement(second, first, transfer_distances(IDENTITY, second, first), sigma=1.0)
    np.testing.assert_allclose(there, back, rtol=1e-4, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(seeds, st.floats(0.5, 20.0))
def test_mean_distances_never_exceed_their_limit_and_shrink_with_it(seed, most):
    first, second = random_walks(seed), random_walks(seed + 1)
    squared = transfer_distances(IDENTITY, first, second)
    found = mean_distance(first, second, squared, most=most)
    assert float(found.max()) <= most * (1 + 1e-5) and float(found.min()) >= 0
    smaller = mean_distance(first, second, squared, most=most / 2)
    assert (smaller <= found * (1 + 1e-5)).all()


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_sampson_distances_are_the_hosts_and_zero_for_exact_matches(seed):
    rng = rng_of(seed)
    f = rng.normal(size=(3, 3))
    u, s, vt = np.linalg.svd(f)
    f = u @ np.diag([s[0], s[1], 0]) @ vt
    xy0, xy1 = rng.normal(size=(2, 40, 2)) * 10
    ours = sampson_distances(*map(np.float32, (f, xy0, xy1)))
    np.testing.assert_allclose(ours, sampson_error(f, xy0, xy1) ** 2, rtol=2e-3, atol=1e-3)
    line = np.c_[xy0, np.ones(40)] @ f.T  # a point on each epipolar line
    on = (
        xy1
        - line[:, :2]
        * ((np.c_[xy1, np.ones(40)] * line).sum(1) / (line[:, :2] ** 2).sum(1))[:, None]
    )
    exact = sampson_distances(*map(np.float32, (f, xy0, on)))
    np.testing.assert_allclose(exact, 0, atol=1e-3)
    scaled = sampson_distances(*map(np.float32, (-7 * f, xy0, xy1)))
    np.testing.assert_allclose(scaled, ours, rtol=1e-3, atol=1e-5)


def test_epipolar_distances_are_those_of_all_pairs_of_ends():
    first, second = random_walks(1), random_walks(2)
    f = np.float32(rng_of(0).normal(size=(3, 3)))
    squared = epipolar_distances(f, first, second)
    a, b = window_positions(first), window_positions(second)
    assert squared.shape == (5, a.shape[1], b.shape[1])
    one = sampson_distances(f, a[3, 7], b[3, 2])
    np.testing.assert_allclose(squared[3, 7, 2], one, **tolerances.UNIT)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_peakiness_lies_between_all_alike_and_one_place(seed):
    values = [float(peakiness(random_walks(seed, temperature=t)).mean()) for t in (50.0, 1.0, 0.1)]
    assert -1e-5 <= values[0] < values[1] < values[2] <= 1 + 1e-5
    flat = WalkProbabilities(np.full((2, 4, 4), 1 / 16, np.float32), np.zeros((2, 2), np.int32))
    np.testing.assert_allclose(peakiness(flat), 0, atol=1e-6)
    np.testing.assert_allclose(peakiness(certain([(1, 1)])), 1, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_cells_under_a_homography_hold_the_mapped_centres(seed):
    h = random_homography(seed)
    offsets = rng_of(seed).normal(size=(81, 2)) * 3
    cells = cells_under_homography(*map(np.float32, (h, offsets)), rows=9, cols=9)
    for k in range(81):
        row, col = divmod(k, 9)
        moved = h @ [8 * col + 3.5, 8 * row + 3.5, 1.0]
        x, y = (moved[:2] / moved[2] + offsets[k] + 0.5) / 8
        if min(abs(x - round(x)), abs(y - round(y))) < 1e-3:
            continue  # on an edge: either cell
        inside = all(1 <= v < 8 for v in (row, col)) and 1 <= x < 8 and 1 <= y < 8 and moved[2] > 0
        assert bool(cells.weight[k] > 0) == inside
        if inside:
            assert cells.cell0[k].tolist() == [row, col]
            assert cells.cell1[k].tolist() == [int(y), int(x)]


def test_cells_that_a_homography_turns_over_are_not_seen():
    """Points behind the camera, whose coordinates lie inside the other view all the same."""
    h = np.float32([[-1.0, 0, 0], [0, -1, 0], [-1 / 30, 0, 1]])
    cells = cells_under_homography(h, np.zeros((81, 2), np.float32), rows=9, cols=9)
    assert not cells.weight.any()
    front = cells_under_homography(-h, np.zeros((81, 2), np.float32), rows=9, cols=9)
    np.testing.assert_array_equal(front.weight, cells.weight)


def test_means_of_nothing_are_zero_and_have_finite_gradients():
    values = np.float32([np.nan, 3.0, 5.0])
    assert float(weighted_mean(values, np.float32([0.0, 1.0, 3.0]))) == 4.5
    assert float(weighted_mean(values, np.zeros(3, np.float32))) == 0
    share = share_within(np.float32([0.5, 4.0, 1.0]), np.asarray([True] * 3), px=1.0)
    assert float(share) == pytest.approx(2 / 3)
    ones, zeros = np.ones(3, np.float32), np.zeros(3, np.float32)
    gradient = compiled(jax.grad(losses.weighted_mean, argnums=1))(ones, zeros)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("loss", ["agreement", "distance", "peakiness", "epipolar"])
def test_gradients_of_losses_are_those_of_central_differences(loss):
    """From the scores of two images to the loss, in float64."""
    with jax.enable_x64(True):
        rng = rng_of(5)
        maps = [rng.gamma(1.0, size=(12, 12)) + 0.1 for _ in range(2)]
        row = col = jnp.arange(1, 4, dtype=jnp.int32)
        f = jnp.asarray(rng.normal(size=(3, 3)))

        @compiled
        @jax.value_and_grad
        def value(maps):
            first, second = (walks.walk([m], row, col, temperature=0.7) for m in maps)
            if loss == "peakiness":
                return losses.peakiness(first).sum()
            if loss == "epipolar":
                squared = losses.epipolar_distances(f, first, second)
            else:
                squared = losses.transfer_distances(jnp.eye(3), first, second)
            if loss == "distance":
                return losses.mean_distance(first, second, squared, most=2.0).sum()
            return losses.agreement(first, second, squared, sigma=1.0).sum()

        _, gradient = value(maps)
        way = [rng.normal(size=m.shape) for m in maps]
        step = 1e-6
        ends = [
            value([m + sign * step * w for m, w in zip(maps, way, strict=True)])[0]
            for sign in (1, -1)
        ]
        slope = sum(np.sum(g * w) for g, w in zip(gradient, way, strict=True))
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-8)
