"""Laws of planes that compete for their correspondences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from compiled import compiled
from strategies import random_homography, rng_of

from jaxsfm.config import PairShape
from jaxsfm.core import planes as core
from jaxsfm.core.ransac import peel_planes
from jaxsfm.core.types import Correspondences, Thresholds

peel = compiled(peel_planes, "shape")
settle, nearest_plane = compiled(core.settle, "rounds"), compiled(core.nearest_plane)
LIMITS = Thresholds(np.float32(4), np.int32(20), np.float32(0.999))
GREEDY = PairShape(local_refits=4)
FAIR = dataclasses.replace(GREEDY, plane_rounds=10)


def two_walls(seed: int, angle: float, *, noise: float = 0.5, outliers: int = 60):
    """Two planes that agree along an edge and part from it, 150 points each."""
    rng = rng_of(seed)
    left = np.asarray([[1.02, 0.01, 12], [-0.01, 0.99, 5], [1e-5, 0, 1]])
    right = left.copy()
    right[0, 0] += angle
    right[0, 2] -= angle * 500  # the same along x = 500
    xy0 = rng.uniform([0, 0], [500, 800], (150, 2)), rng.uniform([500, 0], [1000, 800], (150, 2))
    xy1 = [oracles.transfer(h, x) for h, x in zip((left, right), xy0, strict=True)]
    off = rng.uniform(0, 1000, (2, outliers, 2))
    xy0 = np.concatenate([*xy0, off[0]])
    xy1 = np.concatenate([*xy1, off[1]]) + rng.normal(size=xy0.shape) * noise
    label = np.r_[np.zeros(150, int), np.ones(150, int), np.full(outliers, -1)]
    return np.float32(xy0), np.float32(xy1), label


def wrong(found, label) -> float:
    named = [np.where(found >= 0, np.abs(found - flip), -1) for flip in (0, 1)]
    return min((x != label).mean() for x in named)


@pytest.mark.parametrize("seed", range(5))
def test_competing_planes_part_where_greedy_ones_take_too_much(seed):
    xy0, xy1, label = two_walls(seed, 0.1)
    valid = np.ones(len(label), bool)
    greedy, fair = (
        peel(jax.random.key(seed), xy0, xy1, valid, LIMITS, shape=shape).plane
        for shape in (GREEDY, FAIR)
    )
    assert wrong(fair, label) < 0.12
    assert wrong(fair, label) <= wrong(greedy, label)


def test_every_member_is_nearest_to_its_own_plane():
    xy0, xy1, _ = two_walls(0, 0.1)
    valid = np.arange(len(xy0)) % 7 != 0
    found = peel(jax.random.key(0), xy0, xy1, valid, LIMITS, shape=FAIR)
    plane = found.plane
    errors = np.stack(
        [
            np.linalg.norm(oracles.transfer(h, xy0) - xy1, axis=1)
            for h in found.homographies.astype(np.float64)[found.num_inliers > 0]
        ]
    )
    best, least = errors.argmin(0), errors.min(0)
    clear = np.abs(np.sort(errors, axis=0)[1] - least) > 0.05
    clear &= np.abs(least - 4) > 0.05
    expected = np.where((least < 4) & valid, best, -1)
    np.testing.assert_array_equal(plane[clear], expected[clear])
    counts = np.bincount(plane[plane >= 0], minlength=len(found.num_inliers))
    np.testing.assert_array_equal(found.num_inliers, counts)
    assert (np.diff(counts) <= 0).all()


def test_a_plane_without_points_of_its_own_is_given_up():
    xy0, xy1, _ = two_walls(1, 0.0, noise=0.1, outliers=0)
    h = np.asarray([[1.02, 0.01, 12], [-0.01, 0.99, 5], [1e-5, 0, 1]])
    off = h + np.asarray([[0, 0, 1.5], [0, 0, 0], [0, 0, 0]])
    planes = np.float32([off, h, np.zeros((3, 3))])
    homographies, num, plane = settle(
        planes,
        np.int32([300, 300, 0]),
        Correspondences(xy0, xy1, np.ones(len(xy0), bool)),
        np.float32(4),
        np.int32(20),
        rounds=10,
    )
    assert num.tolist() == [300, 0, 0] and (plane == 0).all()
    at = np.asarray([[0, 0], [1000, 800]], np.float64)
    np.testing.assert_allclose(
        oracles.transfer(np.asarray(homographies[0], np.float64), at),
        oracles.transfer(h, at),
        atol=0.1,
    )


def alone(h, num, xy0, xy1, *, rounds, threshold=4.0, floor=20):
    """`settle` of planes over all points."""
    return settle(
        np.float32(h),
        np.int32(num),
        Correspondences(np.float32(xy0), np.float32(xy1), np.ones(len(xy0), bool)),
        np.float32(threshold),
        np.int32(floor),
        rounds=rounds,
    )


def test_a_plane_is_fitted_again_to_its_own_points():
    """It starts 3 px off and ends on points that are exact."""
    rng = rng_of(3)
    xy0 = rng.uniform(0, 1000, (200, 2))
    truth = random_homography(rng, strength=0.3)
    xy1 = oracles.transfer(truth, xy0)
    shift = np.asarray([[1, 0, 3.0], [0, 1, 0], [0, 0, 1]])
    found, num, plane = alone((shift @ truth)[None], [200], xy0, xy1, rounds=1)
    assert num.tolist() == [200] and (plane == 0).all()
    ends = oracles.transfer(np.asarray(found[0], np.float64), xy0)
    assert np.linalg.norm(ends - xy1, axis=1).max() < 0.1
    left, num, _ = alone((shift @ truth)[None], [200], xy0, xy1, rounds=0)
    np.testing.assert_array_equal(left[0], np.float32(shift @ truth))


def test_a_member_is_nearer_than_the_threshold_and_no_further():
    xy0 = rng_of(4).uniform(0, 1000, (60, 2))
    off = np.repeat([0.5, 3.9, 4.1, 5.6, 7.9, 8.1], 10)
    turn = np.linspace(0, 6, 60)
    xy1 = xy0 + off[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    _, num, plane = alone(np.eye(3)[None], [60], xy0, xy1, rounds=0, floor=4)
    np.testing.assert_array_equal(plane == 0, off < 4)
    assert num.tolist() == [20]


def test_the_threshold_of_competing_planes_is_the_one_of_peeling():
    """A plane keeps what lies within 4 px of it, between it and the 8 px of twice as much none."""
    rng = rng_of(5)
    xy0 = rng.uniform(0, 1000, (220, 2))
    xy1 = xy0.copy()
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    xy1[160:] += 6 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    valid = jnp.ones(len(xy0), bool)
    points = jnp.asarray(xy0, jnp.float32), jnp.asarray(xy1, jnp.float32)
    found = peel(jax.random.key(0), *points, valid, LIMITS, shape=FAIR)
    np.testing.assert_array_equal(np.asarray(found.plane) >= 0, np.arange(220) < 160)


@pytest.mark.parametrize("size", [19, 20])
def test_a_plane_needs_as_many_members_as_are_asked_for(size):
    xy0 = rng_of(6).uniform(0, 1000, (size, 2))
    for rounds in (0, 1):
        _, num, plane = alone(np.eye(3)[None], [size], xy0, xy0, rounds=rounds)
        assert num.tolist() == [size if size >= 20 else 0]
        assert (plane == (0 if size >= 20 else -1)).all()


def test_planes_end_in_order_of_their_members():
    rng = rng_of(7)
    xy0 = rng.uniform(0, 1000, (90, 2))
    label = np.repeat([0, 1, 2], [30, 20, 40])
    shifts = np.asarray([[0, 0], [100, 0], [0, 200]])
    h = np.stack([np.eye(3)] * 3)
    h[:, :2, 2] = shifts
    # The fourth has no points, and no row says so but its count.
    h = np.concatenate([h, np.full((1, 3, 3), np.nan)])
    found, num, plane = alone(h, [30, 20, 40, 0], xy0, xy0 + shifts[label], rounds=2)
    assert num.tolist() == [40, 30, 20, 0]
    np.testing.assert_array_equal(plane, np.asarray([1, 2, 0])[label])
    unit = np.asarray(found[:3]) / np.asarray(found[:3, 2:, 2:])
    np.testing.assert_allclose(unit[:, :2, 2], shifts[[2, 0, 1]], atol=0.05)


def test_without_planes_nothing_is_a_member():
    xy0, xy1, _ = two_walls(2, 0.1)
    none = nearest_plane(
        np.zeros((3, 3, 3), np.float32),
        np.zeros(3, bool),
        Correspondences(xy0, xy1, np.ones(len(xy0), bool)),
        np.float32(4),
    )
    assert (np.asarray(none) == -1).all()
    found = peel(
        jax.random.key(0), xy0, xy1[::-1] * 3 % 997, np.ones(len(xy0), bool), LIMITS, shape=FAIR
    )
    assert found.num_inliers[0] == 0 and not np.asarray(found.homographies).any()


@pytest.mark.parametrize("seed", range(3))
def test_one_plane_keeps_its_points(seed):
    rng = rng_of(seed)
    xy0 = rng.uniform(0, 1000, (200, 2))
    xy1 = oracles.transfer(random_homography(rng, strength=0.5), xy0)
    args = (np.float32(xy0), np.float32(xy1), np.ones(200, bool), LIMITS)
    found = peel(jax.random.key(seed), *args, shape=FAIR)
    assert (np.asarray(found.plane) == 0).all() and found.num_inliers.tolist() == [200, 0, 0, 0, 0]
