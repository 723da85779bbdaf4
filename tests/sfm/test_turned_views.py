"""Which views of a model are turned against the others."""

import numpy as np
import pytest

from jaxsfm.colmap.poses import CameraPose
from jaxsfm.io import orientation
from jaxsfm.sfm.turned_views import quarter_turns

CENTRES = np.random.default_rng(0).normal(size=(8, 3))


def turn(axis: str, degrees: float) -> np.ndarray:
    """A rotation about an axis of the camera."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "x": np.asarray([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.asarray([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def ring(tilts: list[float]) -> dict[str, CameraPose]:
    """Cameras that look in all directions, in a world turned at random; each has its own roll."""
    world = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    world *= np.linalg.det(world)
    return {
        f"{k}": CameraPose(turn("z", tilt) @ turn("y", 40.0 * k) @ world, centre)
        for k, (tilt, centre) in enumerate(zip(tilts, CENTRES, strict=False))
    }


def stored(poses: dict[str, CameraPose], codes: dict[str, int]) -> dict[str, CameraPose]:
    """The poses of photos of which some are stored turned, so that a code makes them upright."""
    turned = {}
    for name, pose in poses.items():
        axes = np.eye(3)
        axes[:2, :2] = orientation.to_stored((1, 1), codes.get(name, 1))[:2, :2]
        turned[name] = CameraPose(axes @ pose.rotation, pose.centre)
    return turned


CODES = {"1": 6, "4": 3, "6": 8}
TURNS = {"1": 1, "4": 2, "6": 3}


@pytest.mark.parametrize("tilt", [0.0, 20.0])
def test_turned_photos_are_found_and_no_others(tilt):
    poses = ring([0, tilt, -tilt, 0, tilt, 0, -tilt, 0])
    assert quarter_turns(stored(poses, CODES), {}) == TURNS
    assert quarter_turns(poses, {}) == {}


def test_photos_that_are_turned_already_are_left_alone():
    poses = stored(ring([0] * 8), CODES)
    assert quarter_turns(poses, CODES) == {}
    assert quarter_turns(poses, {"1": 6, "4": 6, "6": 8}) == {"4": 1}


@pytest.mark.parametrize("tilt", [40.0, 50.0])
def test_a_photo_between_two_turns_stays(tilt):
    assert quarter_turns(ring([0, 0, tilt, 0, 0, 0]), {}) == {}


def test_a_photo_that_looks_straight_down_has_no_upright():
    poses = ring([0] * 8)
    rotation = turn("z", 180) @ turn("x", 75) @ poses["2"].rotation
    assert quarter_turns(poses | {"2": CameraPose(rotation, CENTRES[2])}, {}) == {}
    rotation = turn("z", 180) @ turn("x", 40) @ poses["2"].rotation
    assert quarter_turns(poses | {"2": CameraPose(rotation, CENTRES[2])}, {}) == {"2": 2}


def test_without_a_majority_nothing_is_turned():
    assert quarter_turns(ring([0, 0, 90, 90, 180, 180]), {}) == {}
    assert quarter_turns(ring([0, 0, 0, 0, 180, 180]), {}) == {"4": 2, "5": 2}


def test_no_photos_no_turns():
    assert quarter_turns({}, {}) == {}
