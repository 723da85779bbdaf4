"""Laws of homographies."""

import jax
import numpy as np
import oracles
from compiled import compiled
from hypothesis import given, settings
from strategies import homographies, random_homography, rng_of, seeds
from tolerances import HOMOGRAPHY_PX, UNIT

from jaxsfm.core import homography as hg

SQUARE = np.asarray([[100, 100], [900, 150], [850, 900], [120, 800]], np.float32)
NORMALISE = np.float32([[1 / 350, 0, -500 / 350], [0, 1 / 350, -500 / 350], [0, 0, 1]])
apply_affine, least_squares = compiled(hg.apply_affine), compiled(hg.least_squares)
adjugate, orient = compiled(hg.adjugate), compiled(hg.orient)
from_four_points, normalisation = compiled(hg.from_four_points), compiled(hg.normalisation)
transfer_inliers, transfer_error = compiled(hg.transfer_inliers), compiled(hg.transfer_error)
inliers = compiled(hg.inliers, "two_way")


def solve(xy0, xy1):
    """`from_four_points` through normalised coordinates, as RANSAC uses it."""
    n0, n1 = apply_affine(NORMALISE, xy0), apply_affine(NORMALISE, xy1)
    h, valid = from_four_points(n0, n1)
    t = NORMALISE.astype(np.float64)
    return np.linalg.inv(t) @ h.astype(np.float64) @ t, valid


@settings(max_examples=60, deadline=None)
@given(homographies)
def test_four_points_give_the_homography_that_opencv_finds(h):
    xy1 = oracles.transfer(h, SQUARE).astype(np.float32)
    ours, valid = solve(SQUARE, xy1)
    assert valid
    probe = np.asarray([[0, 0], [1000, 0], [500, 500], [1000, 1000]], np.float64)
    reference = oracles.transfer(oracles.homography(SQUARE, xy1), probe)
    # The probes extrapolate; 1 px of the float32 inputs' rounding can grow tenfold there.
    np.testing.assert_allclose(oracles.transfer(ours, probe), reference, atol=10 * HOMOGRAPHY_PX)
    np.testing.assert_allclose(oracles.transfer(ours, SQUARE), xy1, atol=HOMOGRAPHY_PX)


@settings(max_examples=60, deadline=None)
@given(homographies, seeds)
def test_least_squares_recovers_an_exact_homography(h, seed):
    rng = rng_of(seed)
    xy0 = rng.uniform(0, 1000, (40, 2)).astype(np.float32)
    xy1 = oracles.transfer(h, xy0).astype(np.float32)
    weight = np.ones(40, np.float32)
    weight[30:] = 0
    xy1[30:] += 300  # zero weight: must not matter
    ours = least_squares(xy0, xy1, weight)
    error = oracles.transfer(ours.astype(np.float64), xy0[:30]) - xy1[:30]
    assert np.abs(error).max() < 5 * HOMOGRAPHY_PX


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_least_squares_is_as_good_as_opencvs_on_noisy_points(seed):
    rng = rng_of(seed)
    h = random_homography(rng, strength=0.5)
    xy0 = rng.uniform(0, 1000, (60, 2)).astype(np.float32)
    xy1 = (oracles.transfer(h, xy0) + rng.normal(0, 1, (60, 2))).astype(np.float32)
    ours = least_squares(xy0, xy1, np.ones(60, np.float32))
    reference = oracles.homography(xy0, xy1)

    def rms(m):
        return np.sqrt(((oracles.transfer(m.astype(np.float64), xy0) - xy1) ** 2).sum(1).mean())

    assert rms(ours) < 1.02 * rms(reference)  # algebraic against OpenCV's geometric minimum


def test_three_collinear_points_or_a_mirrored_view_determine_nothing():
    line = SQUARE.copy()
    line[2] = (line[0] + line[1]) / 2
    assert not solve(line, SQUARE)[1]
    assert not solve(SQUARE, line)[1]
    crossed = SQUARE[[0, 2, 1, 3]]
    assert not solve(SQUARE, crossed)[1]
    mirrored = SQUARE * np.asarray([-1, 1], np.float32)
    assert not solve(SQUARE, mirrored)[1]
    same = np.repeat(SQUARE[:1], 4, axis=0)
    assert not solve(same, SQUARE)[1]


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_the_adjugate_inverts_up_to_the_determinant(seed):
    m = rng_of(seed).normal(size=(2, 3, 3)).astype(np.float32)
    product = adjugate(m) @ m
    expected = np.linalg.det(m)[:, None, None] * np.eye(3)
    np.testing.assert_allclose(product, expected, atol=1e-4)


@settings(max_examples=40, deadline=None)
@given(homographies, seeds)
def test_inliers_are_the_points_that_transfer_within_the_threshold(h, seed):
    rng = rng_of(seed)
    xy0 = rng.uniform(0, 1000, (80, 2)).astype(np.float32)
    exact = oracles.transfer(h, xy0)
    xy1 = (exact + rng.normal(0, 8, exact.shape)).astype(np.float32)
    oriented = orient(np.float32(h))
    ours = transfer_inliers(oriented, xy0, xy1, np.float32(10))
    distance = np.linalg.norm(oracles.transfer(h, xy0) - xy1, axis=1)
    decided = np.abs(distance - 10) > HOMOGRAPHY_PX
    np.testing.assert_array_equal(ours[decided], (distance < 10)[decided])


def test_two_way_inliers_swap_with_the_images():
    rng = rng_of(0)
    h = random_homography(rng, strength=1.0)
    xy0 = rng.uniform(0, 1000, (80, 2)).astype(np.float32)
    xy1 = (oracles.transfer(h, xy0) + rng.normal(0, 6, (80, 2))).astype(np.float32)
    n0, n1 = (apply_affine(NORMALISE, x) for x in (xy0, xy1))
    to_unit = NORMALISE.astype(np.float64)
    m = orient(np.float32(to_unit @ h @ np.linalg.inv(to_unit)))
    t = np.float32(10 / 350)
    forward = inliers(m, n0, n1, t, t, two_way=True)
    backward = inliers(orient(adjugate(m)), n1, n0, t, t, two_way=True)
    assert 0 < int(forward.sum()) < 80
    np.testing.assert_array_equal(forward, backward)


def test_points_behind_the_camera_are_no_inliers():
    h = orient(np.float32([[1.0, 0, 0], [0, 1, 0], [-2, 0, 1]]))
    xy0 = np.float32([[0.1, 0.0], [1.0, 0.0]])  # w = 0.8 and -1
    xy1 = xy0 / (1 - 2 * xy0[:, :1])
    np.testing.assert_array_equal(transfer_inliers(h, xy0, xy1, np.float32(0.1)), [True, False])


def test_normalised_points_have_mean_zero_and_radius_root_two():
    xy = np.float32(rng_of(0).uniform(0, 2000, (50, 2)))
    out = apply_affine(normalisation(xy, np.ones(50, np.float32)), xy)
    np.testing.assert_allclose(out.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose((out**2).sum(1).mean(), 2.0, **UNIT)
    same = np.ones((5, 2), np.float32)
    assert np.isfinite(normalisation(same, np.ones(5, np.float32))).all()


def test_an_affinity_is_its_matrix():
    rng = rng_of(2)
    t, xy = rng.normal(size=(3, 3)).astype(np.float32), rng.normal(size=(4, 5, 2))
    t[2] = [0, 0, 1]
    ours = apply_affine(t, np.float32(xy))
    np.testing.assert_allclose(ours, xy @ t[:2, :2].T + t[:2, 2], **UNIT)


def test_in_a_batch_every_sample_is_valid_or_not_by_itself():
    mirrored, line = SQUARE * np.asarray([-1, 1], np.float32), SQUARE.copy()
    line[2] = (line[0] + line[1]) / 2
    # As many samples as points, so that no axis can be taken for another.
    batch = np.stack([SQUARE, mirrored, line, SQUARE[::-1]]) / 500 - 1
    first = np.stack([SQUARE] * 3 + [SQUARE[::-1]]) / 500 - 1
    valid = from_four_points(*map(np.float32, (first, batch)))[1]
    np.testing.assert_array_equal(valid, [True, False, False, True])


def test_the_error_of_a_transfer_is_its_squared_distance_and_infinite_behind_the_camera():
    rng = rng_of(3)
    h = np.stack([random_homography(rng, strength=1.0) for _ in range(2)])
    xy0 = rng.uniform(0, 1000, (30, 2))
    xy1 = xy0 + rng.normal(0, 20, xy0.shape)
    ours = transfer_error(*map(np.float32, (h, xy0, xy1)))
    expected = [((oracles.transfer(m, xy0) - xy1) ** 2).sum(1) for m in h]
    np.testing.assert_allclose(ours, expected, rtol=1e-3, atol=HOMOGRAPHY_PX)
    behind = np.float32([[1.0, 0, 0], [0, 1, 0], [-2, 0, 1]])
    away = transfer_error(
        behind, np.float32([[1.0, 0.0], [0.5, 0.0]]), np.zeros((2, 2), np.float32)
    )
    assert np.isinf(away).all()


def test_an_oriented_homography_has_norm_one_and_a_positive_determinant():
    h = np.stack([random_homography(rng_of(4), strength=1.0)] * 2)
    h[1] *= -3
    ours = orient(np.float32(h)).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(ours, axis=(1, 2)), 1, **UNIT)
    np.testing.assert_allclose(ours[0], ours[1], atol=1e-6)
    assert (np.linalg.det(ours) > 0).all()


def test_vmap_equals_loop():
    rng = rng_of(1)
    xy1 = np.stack([oracles.transfer(random_homography(rng, strength=1), SQUARE) for _ in range(5)])
    xy1, xy0 = np.float32(xy1 / 1000), np.float32(SQUARE / 1000)
    batch, valid = compiled(jax.vmap(hg.from_four_points, in_axes=(None, 0)))(xy0, xy1)
    for i in range(5):
        h, ok = from_four_points(xy0, xy1[i])
        np.testing.assert_allclose(batch[i], h, **UNIT)
        assert ok == valid[i]
