"""A pair whose matches hold two geometries: the second one is found when the first is set aside."""

import shutil

import numpy as np
import pycolmap
import pytest
from epipolar import two_views
from strategies import rng_of

from jaxsfm.colmap.database import copy_geometries, keep_outliers, read_matches
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.two_views import VerificationOptions, read_two_views, verify

FIRST, SECOND = 200, 120
"""Matches of each geometry."""
PAIRS = [("a", "b"), ("a", "c"), ("b", "c")]


@pytest.fixture
def database(tmp_path):
    """Three photos; every two have the matches of two geometries."""
    path = tmp_path / "d.db"
    camera = Intrinsics(model="PINHOLE", params=(600, 600, 320, 240))
    with pycolmap.Database.open(path) as db:
        camera_id = db.write_camera(camera.camera((640, 480)))
        ids = {n: db.write_image(pycolmap.Image(name=n, camera_id=camera_id)) for n in "abc"}
        keypoints = {n: [] for n in "abc"}
        for a, b in PAIRS:
            start = [sum(map(len, keypoints[n])) for n in (a, b)]
            for seed, count in ((0, FIRST), (1, SECOND)):
                _, xy0, xy1 = two_views(rng_of(seed), n=count)
                keypoints[a].append(xy0)
                keypoints[b].append(xy1)
            rows = np.arange(FIRST + SECOND)[:, None] + start
            db.write_matches(ids[a], ids[b], rows.astype(np.uint32))
        for n in "abc":
            db.write_keypoints(ids[n], np.concatenate(keypoints[n]).astype(np.float32))
    verify(path, VerificationOptions(threads=1))
    return path


def inliers(path):
    return {pair: view.geometry.num_inliers for pair, view in read_two_views(path).items()}


def test_what_does_not_agree_with_the_first_geometry_has_the_second(database):
    first = inliers(database)
    assert all(FIRST <= count < FIRST + SECOND // 2 for count in first.values())
    before = read_matches(database, ("a", "b"), verified=True)[0]
    keep_outliers(database, PAIRS[:1])
    left = read_matches(database, ("a", "b"), verified=False)[0]
    assert len(left) == FIRST + SECOND - first["a", "b"]
    assert not {*map(tuple, left)} & {*map(tuple, before)}
    verify(database, VerificationOptions(threads=1))
    second = inliers(database)
    assert len(left) - 3 <= second["a", "b"] <= len(left)
    assert {p: second[p] for p in PAIRS[1:]} == {p: first[p] for p in PAIRS[1:]}


def test_geometries_are_copied_for_the_pairs_that_are_named(database, tmp_path):
    other = tmp_path / "second.db"
    shutil.copyfile(database, other)
    first = inliers(database)
    keep_outliers(other, PAIRS[:2])
    verify(other, VerificationOptions(threads=1))
    every = read_matches(database, PAIRS[0], verified=False)
    copy_geometries(other, database, PAIRS[:1])
    for kept, before in zip(read_matches(database, PAIRS[0], verified=False), every, strict=True):
        np.testing.assert_array_equal(kept, before)
    assert inliers(database) == first | {PAIRS[0]: inliers(other)[PAIRS[0]]}
    at = [read_matches(path, PAIRS[0], verified=True)[0] for path in (database, other)]
    np.testing.assert_array_equal(*at)


def test_a_pair_without_a_second_geometry_loses_its_own(database, tmp_path):
    other = tmp_path / "second.db"
    shutil.copyfile(database, other)
    keep_outliers(other, PAIRS)
    copy_geometries(other, database, PAIRS[:1])
    assert inliers(database).keys() == {*PAIRS[1:]}
