"""Measured positions that contradict the photos, and what is probably meant."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from strategies import rng_of

from jaxsfm.sfm.evaluation import Similarity
from jaxsfm.sfm.georeference.coordinate_system import GPS, LOCAL, coordinate_system
from jaxsfm.sfm.georeference.readings import Fit, is_upside_down, misnamed, misread
from jaxsfm.sfm.georeference.robust_similarity import Anchors, robust_similarity

MIDDLE = np.asarray([8.69, 47.49, 157.0])
UTM = coordinate_system("EPSG:32632", "here")
DEVIATION = 0.05


def walk(rng) -> np.ndarray:
    """Places float64 (10, 3) of a walk around something, metres."""
    angle = np.sort(rng.uniform(0, 2.5, 10))
    height = rng.uniform(-2, 2, 10)
    return np.stack([20 * np.cos(angle), 14 * np.sin(angle), height], 1)


def degrees(places: np.ndarray) -> np.ndarray:
    per_degree = 111_300 * np.asarray([np.cos(np.deg2rad(MIDDLE[1])), 1])
    return np.column_stack([MIDDLE[:2] + places[:, :2] / per_degree, MIDDLE[2] + places[:, 2]])


def found(places: np.ndarray, raw: np.ndarray, system=GPS) -> str | None:
    """What is meant by positions `raw` of cameras at `places`."""
    turn = Rotation.from_rotvec([0.4, 1.0, -0.3]).as_matrix()
    target = system.into(system.frame(raw), raw)
    anchors = Anchors(places @ turn / 7, target, np.full(len(raw), DEVIATION))
    similarity, _ = robust_similarity(anchors)
    return misread(Fit(anchors, similarity), raw, system)


def exchanged(raw):
    return raw[:, [1, 0, 2]]


@pytest.mark.parametrize(
    ("change", "meant"),
    [
        (exchanged, "latitude and longitude were exchanged"),
        (lambda raw: raw * [-1, 1, 1], "the longitude had the other sign"),
        (lambda raw: raw * [1, 1, 1 / 0.3048], "the heights were feet"),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_a_usual_mistake_is_named(change, meant, seed):
    rng = rng_of(seed)
    places = walk(rng)
    raw = degrees(places + rng.normal(0, 0.01, places.shape))
    assert found(places, raw) is None
    assert (found(places, change(raw)) or "").endswith(meant)


@pytest.mark.parametrize("noise", [0.01, 0.5, 5.0])
def test_right_positions_are_not_doubted_however_noisy(noise):
    """By chance, one draw in a hundred may be."""
    for seed in range(20):
        rng = rng_of(seed)
        places = walk(rng)
        raw = degrees(places + rng.normal(0, noise, places.shape))
        assert found(places, raw) is None, seed


def test_three_positions_tell_nothing():
    places = walk(rng_of(0))[::4]
    assert len(places) == 3
    assert found(places, exchanged(degrees(places))) is None


def test_coordinates_that_cannot_be_in_their_system_are_named():
    places = walk(rng_of(0))
    metres = places + [499_984.0, 5_260_000.0, 100.0]
    assert misnamed(metres, UTM) is None
    assert "x and y were exchanged" in (misnamed(exchanged(metres), UTM) or "")
    assert "degrees" in (misnamed(degrees(places), UTM) or "")
    assert "latitude and longitude" in (misnamed(exchanged(degrees(places)), UTM) or "")
    assert misnamed(places, LOCAL) is None
    assert "degrees" in (misnamed(degrees(places), LOCAL) or "")
    # A survey beside its zone, and one that is small and near the origin, are right.
    assert misnamed(metres + [380_000.0, 0, 0], UTM) is None
    assert misnamed(places * [1e-4, 1e-4, 1e-4], LOCAL) is None


def test_cameras_that_hang_upside_down_are_told_where_they_agree():
    level = Rotation.from_euler("x", -90, degrees=True).as_matrix()  # y is down, z looks north
    turns = [Rotation.from_euler("z", a, degrees=True).as_matrix() for a in (0, 40, 80)]
    rotations = {str(k): level @ turn.T for k, turn in enumerate(turns)}
    up = rotations["1"].T @ [0, -1, 0]
    flip = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    as_it_is = Similarity(1.0, np.eye(3), np.zeros(3))
    turned = Similarity(1.0, flip, np.zeros(3))
    stands, hangs = (as_it_is, turned) if up[2] > 0 else (turned, as_it_is)
    assert not is_upside_down(rotations, {}, stands)
    assert is_upside_down(rotations, {}, hangs)
    assert is_upside_down(rotations, {name: 3 for name in rotations}, stands)
    # Cameras that are turned every way, and those that look down, say nothing.
    every = dict(rotations) | {"down": -rotations["0"], "other": -rotations["1"]}
    assert not is_upside_down(every, {}, hangs)
    down = {name: Rotation.from_euler("x", 180, degrees=True).as_matrix() for name in rotations}
    assert not is_upside_down(down, {}, stands) and not is_upside_down(down, {}, hangs)
