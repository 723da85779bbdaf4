"""Batches, devices and memory decide when something is computed, never what."""

import dataclasses
import functools
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
from jaxsfm.cli.arguments import MatchingChoice
from jaxsfm.config import Config, preset
from jaxsfm.core.features import stored
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.pair_shape import FINE_STRIDES
from jaxsfm.core.sharded import device_mesh, join_everywhere
from jaxsfm.errors import UserError
from jaxsfm.io.features import feature_capacity, image_capacity
from jaxsfm.io.images import ImageError, read_image
from jaxsfm.matching import execution, pair_matching
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.extraction import extract_images, image_features
from jaxsfm.matching.pair_matching import ImageCache, match_features, tile_order

FIELDS = ("cells", "keypoints0", "keypoints1", "plane", "homographies", "num_tentative")
MESH = device_mesh(jax.local_devices()[:1])
CONFIG = dataclasses.replace(preset("default"), octaves=2)
"""Four octaves would be twice as many programs to compile."""


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
    return jaxsfm.extract(weights, images, config=CONFIG)


@pytest.fixture(scope="module")
def matches(features):
    pairs = jaxsfm.exhaustive_pairs(features)
    return jaxsfm.match(features, pairs, config=CONFIG)


def assert_same_matches(ours, expected):
    assert ours.keys() == expected.keys()
    for pair, want in expected.items():
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(ours[pair], field), getattr(want, field))


@pytest.mark.slow
def test_memory_for_two_images_gives_the_same_matches(features, matches):
    tight = Execution(memory_gb=1e-6)
    pairs = list(matches)[::-1]
    ours = jaxsfm.match(features, pairs, config=CONFIG, execution=tight)
    assert_same_matches(ours, matches)
    (a, b), want = max(matches.items(), key=lambda item: item[1].num_inliers)
    assert want.num_inliers > 100
    alone = match_features(features[a], features[b], config=CONFIG)
    assert_same_matches({(a, b): alone}, {(a, b): want})


@pytest.mark.slow
def test_pairs_side_by_side_give_the_same_matches_up_to_rounding(features, matches):
    together = Execution(pairs_at_once=3)
    ours = jaxsfm.match(features, list(matches), config=CONFIG, execution=together)
    for pair, want in matches.items():
        cells = {tuple(c) for c in want.cells.tolist()}
        same = cells & {tuple(c) for c in ours[pair].cells.tolist()}
        assert len(same) >= 0.99 * max(len(cells), len(ours[pair].cells))


@pytest.mark.slow
def test_images_side_by_side_give_the_same_features_up_to_rounding(weights, images, features):
    together = Execution(images_at_once=3)
    ours = jaxsfm.extract(weights, images, config=CONFIG, execution=together)
    for name, want in features.items():
        for one, other in zip(ours[name].dense.coarse, want.dense.coarse, strict=True):
            np.testing.assert_allclose(one, other, atol=2e-3)  # two steps of float16 at 1
            assert one.dtype == np.float16
        same = (ours[name].dense.keypoints == want.dense.keypoints).all(1).mean()
        assert same > 0.99


SCRIPT = """
import dataclasses, json, sys
from pathlib import Path
import jax, numpy as np, jaxsfm
from jaxsfm.matching.execution import Execution
assert len(jax.devices()) == 3
images, _ = jaxsfm.open_images(Path(sys.argv[1]))
weights = jaxsfm.load_weights()
config = dataclasses.replace(jaxsfm.preset("default"), octaves=2)
everything = []
for execution in (Execution(devices=1), Execution(memory_gb=1e-6)):
    features = jaxsfm.extract(weights, images, config=config, execution=execution)
    pairs = jaxsfm.exhaustive_pairs(features)
    matches = jaxsfm.match(features, pairs, config=config, execution=execution)
    arrays = [jax.tree.leaves(features[n].dense) for n in sorted(features)]
    arrays += [[m.cells, m.keypoints1, m.plane, m.homographies] for _, m in sorted(matches.items())]
    everything.append([np.asarray(a).tobytes() for each in arrays for a in each])
one, three = everything
print(json.dumps([len(one), all(a == b for a, b in zip(one, three, strict=True))]))
"""


@pytest.mark.optimized
@pytest.mark.slow
def test_any_number_of_devices_gives_what_one_gives_bit_for_bit(folder):
    """Three devices for five images and ten pairs: the last batches are not full."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=3"
    environment = os.environ | {"XLA_FLAGS": flags}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    count, same = json.loads(done.stdout.splitlines()[-1])
    assert count > 50 and same


@pytest.mark.optimized
@pytest.mark.slow
def test_features_are_the_programs_rounded_once(weights, images):
    image, config = images[0], CONFIG
    found = image_features(weights, image, config=config)
    expected = compute_features(weights, read_image(image, max_size=config.max_size), config=config)
    for one, other in zip(
        jax.tree.leaves(found.dense), jax.tree.leaves(stored(jax.device_put(expected))), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    assert found.dense.coarse[0].dtype == np.float16
    assert found.capacity == feature_capacity(image.size)


@given(
    st.tuples(st.integers(48, 5000), st.integers(48, 5000)),
    st.sampled_from(sorted(FINE_STRIDES.values())),
)
def test_a_capacity_holds_the_cells_of_its_image(size, stride):
    capacity = feature_capacity(size, fine_stride=stride)
    fine = [side // stride for side in size]
    coarse = [side // (2 * stride) for side in size]
    assert capacity.num_coarse >= coarse[0] * coarse[1] and capacity.columns == coarse[0]
    assert 4 * capacity.num_coarse >= fine[0] * fine[1]


@pytest.mark.slow
@pytest.mark.parametrize("layers", ["conv4_3/conv3_3", "pool5/conv5_3"])
def test_other_layers_match_with_cells_of_their_own_size(weights, images, layers):
    config = Config(layers=layers)
    found = [image_features(weights, image, config=config) for image in images[:2]]
    for features in found:
        assert features.capacity == image_capacity(features.image, config=config)
        width, height = (side // config.fine_stride for side in features.image.size)
        xy = features.dense.keypoints[: width * height].reshape(height, width, 2)
        own = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
        np.testing.assert_array_equal(xy // config.fine_stride, own)
    result = match_features(*found, config=config)
    least = {"conv4_3/conv3_3": 300, "pool5/conv5_3": 26}
    assert result.num_inliers >= least[layers]


@pytest.mark.slow
def test_a_photo_that_went_away_is_told_and_the_others_are_there(weights, images, tmp_path):
    gone = dataclasses.replace(images[1], path=tmp_path / "gone.png")
    some = [images[0], gone, *images[2:]]
    for at_once in (1, 4):
        found = dict(
            extract_images(
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
    ordered = tile_order(pairs, side)
    assert sorted(ordered) == sorted(pairs)

    loads = []
    most = 2 * side
    cache = ImageCache(lambda name: loads.append(name) or name, ordered, most)
    for a, b in ordered:
        assert (cache.take(a), cache.take(b)) == (a, b)
        assert len(cache) <= most
    assert len(cache) == 0
    blocks = -(-count // side)
    # A tile needs both its blocks; the first of them is still there from the tile before.
    assert len(loads) <= side * (blocks * (blocks + 1) // 2 + blocks)
    if count <= most:
        assert len(loads) == count


def test_along_a_street_every_image_is_loaded_once_whatever_the_names():
    names = np.random.default_rng(0).permutation(400).tolist()
    near = [(names[k], names[k + d]) for k in range(400) for d in range(1, 8) if k + d < 400]
    ordered = tile_order(sorted(tuple(sorted(pair)) for pair in near), 8)
    loads = []
    cache = ImageCache(lambda name: loads.append(name) or name, ordered, 16)
    for a, b in ordered:
        cache.take(a)
        cache.take(b)
    assert len(loads) <= 1.1 * 400


def test_a_hosts_memory_does_not_grow_with_the_number_of_small_images():
    config = preset("default")
    assert execution.cached_images(Execution(), MESH, 512, config=config) <= 32
    large = execution.cached_images(Execution(), MESH, 8192, config=config)
    assert 2 <= large <= 16


@pytest.mark.slow
@pytest.mark.parametrize("products", ["float32", "float16"])
def test_memory_is_what_the_formula_says(features, products):
    config = dataclasses.replace(CONFIG, products=products)
    (one, *_) = features.values()
    joined = jax.jit(functools.partial(join_octaves, products=products))(one.dense)
    size = sum(x.nbytes for x in jax.tree.leaves(joined))
    assert execution.joined_bytes(one.capacity.num_coarse, config=config) == size
    for budget, most in ((10.5 * size, 10), (size, 2)):
        chosen = Execution(memory_gb=budget / 1e9)
        found = execution.cached_images(chosen, MESH, one.capacity.num_coarse, config=config)
        assert found == most


def test_a_cpu_takes_one_at_a_time_unless_told():
    config = preset("default")
    assert execution.images_at_once(Execution(), MESH, 10**6, 99) == 1
    assert execution.pairs_at_once(Execution(), MESH, 6144, 99, config=config) == 1
    told = Execution(images_at_once=6, pairs_at_once=7)
    assert execution.images_at_once(told, MESH, 10**6, 99) == 6
    assert execution.pairs_at_once(told, MESH, 6144, 99, config=config) == 7
    for count, most in ((1, 1), (2, 2), (3, 4), (5, 7)):  # no more than there are, few programs
        assert execution.pairs_at_once(told, MESH, 6144, count, config=config) == most


@pytest.mark.parametrize("memory", [8e9, 24e9, 140e9])
def test_an_accelerator_takes_what_fits(monkeypatch, memory):
    config = preset("default")
    monkeypatch.setattr(execution, "_device_memory", lambda _: int(memory))
    pixels, cells = 1600 * 1200, 8192
    images = execution.images_at_once(Execution(), MESH, pixels, 999)
    pairs = execution.pairs_at_once(Execution(), MESH, cells, 999, config=config)
    kept = execution.cached_images(Execution(), MESH, cells, config=config)
    joined = execution.joined_bytes(cells, config=config)
    assert images == 1 or images * execution.ACCELERATOR_BYTES_PER_PIXEL * pixels <= memory / 2
    batch = pairs * (2 * joined + execution.PAIR_BYTES_PER_CELL * cells)
    assert kept * joined + batch <= memory
    # And not much less than fits, up to what is asked for at most.
    assert images in (1, execution.MAX_IMAGES, int(memory / 2 / (3000 * pixels)))
    assert pairs == execution.MAX_PAIRS or batch > memory / 8


def test_at_most_256_pairs_of_small_photos_are_side_by_side(monkeypatch):
    monkeypatch.setattr(execution, "_device_memory", lambda _: int(80e9))
    config = preset("default")
    assert execution.pairs_at_once(Execution(), MESH, 512, 9999, config=config) == 256


def test_the_next_batch_is_loaded_while_one_runs():
    log = []

    def batches():
        for k in range(3):
            log.append(f"load {k}")
            yield k

    def start(k):
        log.append(f"start {k}")
        return k

    def finish(k):
        log.append(f"finish {k}")
        yield k

    assert list(execution.overlap_batches(batches(), start, finish)) == [0, 1, 2]
    expected = "load 0, start 0, load 1, start 1, finish 0, load 2, start 2, finish 1, finish 2"
    assert ", ".join(log) == expected


def test_executions_refuse_what_makes_no_sense():
    for wrong in (
        {"devices": 0},
        {"images_at_once": 0},
        {"pairs_at_once": -1},
        {"memory_gb": 0.0},
        {"memory_gb": float("inf")},
        {"memory_gb": float("nan")},
    ):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Execution(**wrong)
    with pytest.raises(UserError, match="--devices 99: there are"):
        execution.select_devices(Execution(devices=99))


@pytest.mark.parametrize("products", ["float32", "bfloat16"])
def test_matches_are_computed_from_descriptors_of_the_type_that_the_config_says(
    features, monkeypatch, products
):
    """The option, the config and the arrays on the device agree."""
    config = MatchingChoice(preset="paper", products=products).config()
    assert config.products == products
    seen = []

    def noted(*args, **kwargs):
        found = join_everywhere(*args, **kwargs)
        seen.append(found)
        return found

    monkeypatch.setattr(pair_matching, "_join", noted)
    bare = [
        each._replace(
            dense=each.dense._replace(coarse=each.dense.coarse[:1], fine=each.dense.fine[:1])
        )
        for each in list(features.values())[:2]
    ]
    match_features(*bare, config=config)
    assert len(seen) == 2
    assert {x.dtype.name for each in seen for x in (each.coarse, each.fine)} == {products}
