"""Photos from one place are told from photos that give depth."""

import functools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsfm.sfm.limits import ONE_PLACE
from jaxsfm.sfm.one_place import FOCALS, eigenvalue_spread, singular_spreads, turn_between

SIZE, FOCAL = (320, 240), 300.0
K = np.asarray([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1]])
NORMAL = np.asarray([0.0, 0.0, 1.0])
"""A wall before the camera, at the distance 1."""


@functools.cache
def wall(seed: int = 0) -> np.ndarray:
    """What a camera of twice the focal length sees: float32 (960, 1280), textured at all scales."""
    random = np.random.default_rng(seed)
    whole = np.zeros((960, 1280))
    for octave in range(8):
        noise = random.normal(size=(960 >> octave, 1280 >> octave))
        whole += cv2.resize(noise, (1280, 960), interpolation=cv2.INTER_CUBIC)
    return (128 + 50 * whole / whole.std()).astype(np.float32)


WIDE = np.asarray([[2 * FOCAL, 0, 639.5], [0, 2 * FOCAL, 479.5], [0, 0, 1]])


def turn(*degrees: float) -> np.ndarray:
    return cv2.Rodrigues(np.radians(degrees))[0]


def plane_homography(rotation: np.ndarray, shift=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Moves pixels of a photo to those of another one, of a wall at distance 1."""
    return K @ (rotation + np.outer(shift, NORMAL)) @ np.linalg.inv(K)


def seen(homography: np.ndarray, seed: int = 0) -> np.ndarray:
    """The photo of the wall to which a homography moves the pixels of the first photo."""
    photo = cv2.warpPerspective(
        wall(seed), homography @ K @ np.linalg.inv(WIDE), SIZE, flags=cv2.INTER_AREA
    )
    noise = np.random.default_rng(seed + 1).normal(0, 2, photo.shape)
    return (photo + noise).astype(np.float32)


def rough(homography: np.ndarray) -> np.ndarray:
    """A start that is a pixel or two off."""
    return np.asarray([[1.002, 0.001, 1.2], [-0.001, 0.998, -1.0], [0, 0, 1]]) @ homography


def aligned(first: np.ndarray, second: np.ndarray, start: np.ndarray) -> bool:
    return turn_between(first, second, start) is not None


TURNED = plane_homography(turn(3, 5, 4))
FIRST = seen(np.eye(3))


def test_photos_that_differ_by_a_turn_are_aligned():
    assert aligned(FIRST, seen(TURNED), rough(TURNED))
    assert aligned(FIRST, FIRST, np.eye(3))


def test_light_and_unused_pixels_do_not_matter():
    second = 0.6 * seen(TURNED) + 20
    second[:60, :90] = np.nan
    first = FIRST.copy()
    first[200:] = np.nan
    assert aligned(first, second, rough(TURNED))


def test_a_wall_from_two_places_is_not_a_turn():
    """Photos of it are aligned as well, but not by the homography of a turn."""
    moved = plane_homography(turn(3, 5, 4), (0.03, 0.01, 0.0))
    assert not aligned(FIRST, seen(moved), rough(moved))


def test_things_at_two_distances_are_not_aligned():
    second = seen(TURNED)
    near = plane_homography(turn(3, 5, 4)) @ np.asarray([[1, 0, 9], [0, 1, 0], [0, 0, 1]])
    second[:, 160:] = seen(near)[:, 160:]
    assert not aligned(FIRST, second, rough(TURNED))


@pytest.mark.parametrize(
    "second",
    [seen(np.eye(3), 7), np.full_like(FIRST, 90), np.full_like(FIRST, np.nan)],
    ids=["another wall", "plain", "nothing used"],
)
def test_photos_that_have_nothing_in_common_are_not_aligned(second):
    assert not aligned(FIRST, second, np.eye(3))


def test_a_start_beside_the_photo_is_not_followed():
    away = np.asarray([[1, 0, 2000], [0, 1, 0], [0, 0, 1.0]])
    assert not aligned(FIRST, seen(TURNED), away)


angles = st.floats(-40, 40)


@settings(max_examples=50, deadline=None)
@given(angles, angles, angles, st.floats(200, 3000), st.floats(0.1, 10))
def test_the_eigenvalues_of_a_turn_do_not_depend_on_the_camera(x, y, z, focal, scale):
    camera = np.asarray([[focal, 0, 400], [0, focal, 300], [0, 0, 1]])
    homography = camera @ turn(x, y, z) @ np.linalg.inv(camera)
    assert eigenvalue_spread(scale * homography) < 1e-6


@settings(max_examples=50, deadline=None)
@given(angles, angles, angles, st.sampled_from(FOCALS.tolist()))
def test_the_singular_values_of_a_turn_are_equal_for_its_focal_length(x, y, z, focal):
    camera = np.asarray([[focal * 640, 0, 319.5], [0, focal * 640, 239.5], [0, 0, 1]])
    spreads = singular_spreads(camera @ turn(x, y, z) @ np.linalg.inv(camera), (480, 640))
    assert spreads[np.argmin(np.abs(FOCALS - focal))] < 1e-6
    assert np.isfinite(spreads).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.08, 0.3), st.floats(0, 10), st.booleans())
def test_a_way_before_a_wall_is_no_turn_on_one_spot(seed, baseline, unsteady, forward):
    """One pair may look like a turn by accident; three quarters of them do not."""
    random = np.random.default_rng(seed)
    shift = (0, 0, baseline) if forward else (baseline, 0, 0)
    pairs = [plane_homography(turn(*random.normal(0, unsteady, 3)), shift) for _ in range(12)]
    told = np.asarray([eigenvalue_spread(each) <= ONE_PLACE.eigenvalues for each in pairs])
    fits = np.asarray([singular_spreads(each, SIZE[::-1]) for each in pairs])
    fits = (fits <= ONE_PLACE.singular_values) & told[:, None]
    assert fits.sum(0).max() < ONE_PLACE.share * len(pairs)


def test_a_camera_that_moves_along_a_wall_is_told_by_the_singular_values():
    """The eigenvalues of a shift are those of no turn at all."""
    shift = np.asarray([[1, 0, 64.0], [0, 1, 0], [0, 0, 1]])
    assert eigenvalue_spread(shift) < 1e-9
    assert singular_spreads(shift, SIZE[::-1]).min() > ONE_PLACE.singular_values


def test_a_homography_without_an_inverse_is_no_turn():
    assert eigenvalue_spread(np.diag([1.0, 1.0, 0.0])) == np.inf
    assert (singular_spreads(np.diag([1.0, 1.0, 0.0]), (9, 9)) == np.inf).all()
