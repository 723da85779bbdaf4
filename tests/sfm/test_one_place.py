"""Photos from one place are told from photos that give depth."""

import functools
import itertools
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from textures import texture

from jaxsfm.colmap.two_views import ImageKeypoints, Inliers
from jaxsfm.io.images import ImageError
from jaxsfm.io.photos import Photos
from jaxsfm.sfm import one_place
from jaxsfm.sfm.limits import ONE_PLACE
from jaxsfm.sfm.one_place import (
    FOCALS,
    eigenvalue_spread,
    from_one_place,
    singular_spreads,
    turn_between,
)

SIZE, FOCAL = (320, 240), 300.0
K = np.asarray([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1]])
NORMAL = np.asarray([0.0, 0.0, 1.0])
"""A wall before the camera, at the distance 1."""


@functools.cache
def wall(seed: int = 0) -> np.ndarray:
    """What a camera of twice the focal length sees: float32 (960, 1280)."""
    return (128 + 50 * texture(seed, (1280, 960))).astype(np.float32)


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


def test_where_a_third_shows_something_else_a_turn_does_not_explain_the_photos():
    """The rest is aligned as well as before, so the homography is that of the turn."""
    second = seen(TURNED)
    second[:, :100] = np.random.default_rng(1).normal(128, 40, (SIZE[1], 100))
    assert not aligned(FIRST, second, rough(TURNED))


def test_plain_areas_do_not_count():
    """Their noise is another one in each photo."""
    first, second = FIRST.copy(), seen(TURNED)
    noise = np.random.default_rng(3).normal(200, 2, (2, *first.shape)).astype(np.float32)
    first[:, 170:] = noise[0][:, 170:]
    edge = cv2.warpPerspective((first == noise[0]).astype(np.uint8), TURNED, SIZE) > 0
    second[edge] = noise[1][edge]
    assert aligned(first, second, rough(TURNED))


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


# -- whole sets ------------------------------------------------------------------------------------


class Seen:
    """Photos of a wall, one for each homography from a first photo, without files."""

    def __init__(self, moves: list[np.ndarray]) -> None:
        self.moves = {f"{k:02}": move for k, move in enumerate(moves)}

    def gray(self, name: str) -> tuple[np.ndarray, tuple[float, float]]:
        if name == "gone":
            raise ImageError("gone: cannot be read")
        return seen(self.moves[name]), (1.0, 1.0)

    def inliers(self, off_px: float = 0.7) -> Inliers:
        """Matches of a grid of points between all photos, each a little off."""
        random = np.random.default_rng(0)
        x, y = np.meshgrid(np.linspace(40, 280, 9), np.linspace(40, 200, 7))
        grid = np.stack([x.ravel(), y.ravel()], -1)
        keypoints = {}
        for name, move in self.moves.items():
            xy = cv2.perspectiveTransform(grid[None], move)[0]
            keypoints[name] = ImageKeypoints(xy + random.normal(0, off_px, xy.shape), SIZE)
        same = np.repeat(np.arange(len(grid))[:, None], 2, axis=1)
        return Inliers(keypoints, dict.fromkeys(itertools.combinations(self.moves, 2), same))


@pytest.fixture
def asked(monkeypatch):
    """A function that asks whether photos are from one place, given their matches."""

    def ask(photos: Seen, found: Inliers) -> bool:
        monkeypatch.setattr(one_place, "read_inliers", lambda _: found)
        return from_one_place(Path(), cast(Photos, photos))

    return ask


def turns(count: int) -> list[np.ndarray]:
    return [plane_homography(turn(1.5 * (k % 3), 2.0 * k - 4, 3.0 * (k % 2))) for k in range(count)]


def test_turned_photos_are_from_one_place_and_others_are_not(asked):
    turned = Seen(turns(6))
    assert asked(turned, turned.inliers())
    walked = Seen([plane_homography(turn(0, 3.0 * k, 0), (-0.05 * k, 0, 0)) for k in range(6)])
    assert not asked(walked, walked.inliers())


def test_a_camera_that_slides_along_a_wall_is_not_on_one_spot(asked):
    slid = Seen([np.asarray([[1, 0, 45.0 * k], [0, 1, 10.0 * k], [0, 0, 1]]) for k in range(5)])
    assert not asked(slid, slid.inliers())


def test_a_quarter_of_the_pairs_may_be_others(asked):
    """False pairs, moving things and photos that cannot be read hide turns."""
    turned = Seen(turns(6))
    found = turned.inliers()
    pairs = sorted(found.matches)
    at = np.linspace(0, len(pairs) - 1, ONE_PLACE.pairs).round().astype(int)
    allowed = int((1 - ONE_PLACE.share) * ONE_PLACE.pairs)
    for broken, answer in ((allowed, True), (allowed + 1, False)):
        shuffled = {pairs[k]: found.matches[pairs[k]] * [1, 0] for k in at[:broken]}
        assert asked(turned, Inliers(found.keypoints, found.matches | shuffled)) == answer


def test_neighbours_that_look_like_turns_are_not_enough(asked):
    """A third of the pairs of neighbouring photos may: of kitchen, a quarter do."""
    turned = Seen(turns(6))
    found = turned.inliers()
    pairs = sorted(found.matches)
    at = np.linspace(0, len(pairs) - 1, ONE_PLACE.pairs).round().astype(int)
    shuffled = {pairs[k]: found.matches[pairs[k]] * [1, 0] for k in at[4:]}
    assert not asked(turned, Inliers(found.keypoints, found.matches | shuffled))


def test_turns_of_different_cameras_are_not_from_one_place(asked):
    """What looks like a turn, but of another focal length in each pair, is no turn."""
    focals = [0.5, 0.8, 1.2, 1.8, 2.6]
    moves = [np.diag([f, f, 1.0]) for f in focals]
    centre = np.asarray([[1, 0, 159.5], [0, 1, 119.5], [0, 0, 1]])
    cameras = [centre @ (FOCAL * move / move[2, 2]) @ np.diag([1, 1, 1 / FOCAL]) for move in moves]
    zoomed = Seen([np.eye(3), *(k @ turn(0, 9, 5) @ np.linalg.inv(k) for k in cameras)])
    found = zoomed.inliers()
    each = {pair: rows for pair, rows in found.matches.items() if pair[0] == "00"}
    assert not asked(zoomed, Inliers(found.keypoints, each))


def test_without_pairs_of_one_size_nothing_is_said(asked):
    turned = Seen(turns(3))
    found = turned.inliers()
    assert not asked(turned, Inliers(found.keypoints, {}))
    sizes = {n: each._replace(size=(320, 240 + int(n))) for n, each in found.keypoints.items()}
    assert not asked(turned, Inliers(sizes, found.matches))
    gone = {"gone": found.keypoints["00"], "01": found.keypoints["01"]}
    assert not asked(turned, Inliers(gone, {("01", "gone"): found.matches["00", "01"]}))
