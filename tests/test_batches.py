"""Batches, devices and memory decide when something is computed, never what."""

import dataclasses
import itertools
import json
import os
import subprocess
import sys

import cv2
import jax
import numpy as np
import pytest
from described import compute_features
from hypothesis import given
from hypothesis import strategies as st

import jaxsfm
from jaxsfm import execution, matching
from jaxsfm.config import preset
from jaxsfm.core.features import stored
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.sharded import device_mesh
from jaxsfm.errors import UserError
from jaxsfm.execution import Execution
from jaxsfm.extraction import extracted, image_features
from jaxsfm.host.features import room_of
from jaxsfm.host.images import ImageError, read_image
from jaxsfm.matching import by_tiles, match_features

FIELDS = ("cells", "keypoints0", "keypoints1", "plane", "homographies", "num_tentative")
MESH = device_mesh(jax.local_devices()[:1])


@pytest.fixture(scope="module")
def folder(photos, tmp_path_factory):
    """Five photos of two sizes; neighbours overlap."""
    path = tmp_path_factory.mktemp("photos")
    for k in range(5):
        size = (240, 180) if k != 3 else (200, 230)
        crop = photos[2][20 * k : 20 * k + 400, 30 * k : 30 * k + 460]
        cv2.imwrite(str(path / f"{k}.png"), cv2.resize(crop, size, interpolation=cv2.INTER_AREA))
    return path


@pytest.fixture(scope="module")
def images(folder):
    return jaxsfm.open_images(folder)[0]


@pytest.fixture(scope="module")
def features(weights, images):
    return jaxsfm.extract(weights, images, config=preset("default"))


@pytest.fixture(scope="module")
def matches(features):
    pairs = jaxsfm.exhaustive_pairs(features)
    return jaxsfm.match(features, pairs, config=preset("default"))


def assert_same_matches(ours, expected):
    assert ours.keys() == expected.keys()
    for pair, want in expected.items():
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(ours[pair], field), getattr(want, field))


def test_memory_for_two_images_gives_the_same_matches(features, matches):
    tight = Execution(memory_gb=1e-6)
    pairs = list(matches)[::-1]
    ours = jaxsfm.match(features, pairs, config=preset("default"), execution=tight)
    assert_same_matches(ours, matches)
    (a, b), want = max(matches.items(), key=lambda item: item[1].num_inliers)
    assert want.num_inliers > 100
    alone = match_features(features[a], features[b], config=preset("default"))
    assert_same_matches({(a, b): alone}, {(a, b): want})


def test_pairs_side_by_side_give_the_same_matches_up_to_rounding(features, matches):
    together = Execution(pairs_at_once=3)
    ours = jaxsfm.match(features, list(matches), config=preset("default"), execution=together)
    for pair, want in matches.items():
        cells = {tuple(c) for c in want.cells.tolist()}
        same = cells & {tuple(c) for c in ours[pair].cells.tolist()}
        assert len(same) >= 0.99 * max(len(cells), len(ours[pair].cells))


def test_images_side_by_side_give_the_same_features_up_to_rounding(weights, images, features):
    together = Execution(images_at_once=3)
    ours = jaxsfm.extract(weights, images, config=preset("default"), execution=together)
    for name, want in features.items():
        for one, other in zip(ours[name].dense.coarse, want.dense.coarse, strict=True):
            np.testing.assert_allclose(one, other, atol=2e-3)  # two steps of float16 at 1
        same = (ours[name].dense.keypoints == want.dense.keypoints).all(1).mean()
        assert same > 0.99


SCRIPT = """
import json, sys
from pathlib import Path
import jax, numpy as np, jaxsfm
from jaxsfm.execution import Execution
assert len(jax.devices()) == 3
images, _ = jaxsfm.open_images(Path(sys.argv[1]))
weights, config = jaxsfm.load_weights(), jaxsfm.preset("default")
everything = []
for execution in (Execution(devices=1), Execution(), Execution(devices=2, memory_gb=1e-6)):
    features = jaxsfm.extract(weights, images, config=config, execution=execution)
    pairs = jaxsfm.exhaustive_pairs(features)
    matches = jaxsfm.match(features, pairs, config=config, execution=execution)
    arrays = [jax.tree.leaves(features[n].dense) for n in sorted(features)]
    arrays += [[m.cells, m.keypoints1, m.plane, m.homographies] for _, m in sorted(matches.items())]
    everything.append([np.asarray(a).tobytes() for each in arrays for a in each])
print(json.dumps([len(everything[0]), [all(a == b for a, b in zip(everything[0], other,
    strict=True)) for other in everything[1:]]]))
"""


def test_any_number_of_devices_gives_what_one_gives_bit_for_bit(folder):
    """Three devices for five images and ten pairs: the last batches are not full."""
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=3"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    count, same = json.loads(done.stdout.splitlines()[-1])
    assert count > 50 and same == [True, True]


def test_features_are_the_programs_rounded_once(weights, images):
    image, config = images[0], preset("default")
    found = image_features(weights, image, config=config)
    expected = compute_features(weights, read_image(image, max_size=config.max_size), config=config)
    for one, other in zip(
        jax.tree.leaves(found.dense), jax.tree.leaves(stored(jax.device_put(expected))), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    assert found.dense.coarse[0].dtype == np.float16
    assert found.room == room_of(image.size)


def test_a_photo_that_went_away_is_told_and_the_others_are_there(weights, images, tmp_path):
    gone = dataclasses.replace(images[1], path=tmp_path / "gone.png")
    some = [images[0], gone, *images[2:]]
    for at_once in (1, 4):
        found = dict(
            extracted(
                weights,
                some,
                config=preset("paper"),
                execution=Execution(images_at_once=at_once),
            )
        )
        assert set(found) == set(some)
        assert [i for i, f in found.items() if isinstance(f, ImageError)] == [gone]
    with pytest.raises(ImageError, match="1.png"):
        jaxsfm.extract(weights, some, config=preset("paper"))


@given(st.integers(2, 14), st.integers(1, 6), st.randoms())
def test_tiles_keep_every_pair_once_and_images_at_hand(count, side, random):
    pairs = list(itertools.combinations(range(count), 2))
    random.shuffle(pairs)
    ordered = by_tiles(pairs, side)
    assert sorted(ordered) == sorted(pairs)

    loads = []

    class Counted(matching._Resident):
        def _join(self, name):
            loads.append(name)
            return name

    most = 2 * side
    resident = Counted(None, ordered, MESH, 0, most)
    for a, b in ordered:
        assert (resident.take(a), resident.take(b)) == (a, b)
        assert len(resident._images) <= most
    assert not resident._images
    blocks = -(-count // side)
    # A tile needs both its blocks; the first of them is still there from the tile before.
    assert len(loads) <= side * (blocks * (blocks + 1) // 2 + blocks)
    if count <= most:
        assert len(loads) == count


def test_memory_is_what_the_formula_says(features):
    config = preset("default")
    (one, *_) = features.values()
    joined = jax.jit(join_octaves)(one.dense)
    size = sum(x.nbytes for x in jax.tree.leaves(joined))
    assert execution.joined_bytes(one.room.num_coarse, octaves=4) == size
    for budget, most in ((10.5 * size, 10), (size, 2)):
        chosen = Execution(memory_gb=budget / 1e9)
        found = execution.resident_images(chosen, MESH, one.room.num_coarse, config=config)
        assert found == most


def test_a_cpu_takes_one_at_a_time_unless_told():
    config = preset("default")
    assert execution.images_at_once(Execution(), MESH, 10**6) == 1
    assert execution.pairs_at_once(Execution(), MESH, 6144, config=config) == 1
    assert execution.pairs_at_once(Execution(pairs_at_once=7), MESH, 6144, config=config) == 7


def test_an_accelerator_takes_what_fits(monkeypatch):
    config = preset("default")
    chosen = []
    for memory in (8e9, 24e9, 140e9):
        monkeypatch.setattr(execution, "_device_memory", lambda _, memory=memory: int(memory))
        images = execution.images_at_once(Execution(), MESH, 1600 * 1200)
        pairs = execution.pairs_at_once(Execution(), MESH, 8192, config=config)
        kept = execution.resident_images(Execution(), MESH, 8192, config=config)
        joined = execution.joined_bytes(8192, octaves=4)
        assert kept * joined <= memory / 2
        chosen.append((images, pairs, kept))
    assert chosen == sorted(chosen) and chosen[0] < chosen[-1]
    assert chosen[-1][0] <= execution.MAX_IMAGES and chosen[-1][1] <= execution.MAX_PAIRS


def test_executions_refuse_what_makes_no_sense():
    for wrong in ({"devices": 0}, {"images_at_once": 0}, {"pairs_at_once": -1}, {"memory_gb": 0.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Execution(**wrong)
    with pytest.raises(UserError, match="--devices 99: there are"):
        execution.chosen_devices(Execution(devices=99))
