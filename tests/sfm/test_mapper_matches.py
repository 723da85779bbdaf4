"""Laws of the share of the matches that the mapper is given."""

import numpy as np
import pytest
from oracles import mapper_matches as oracle
from strategies import rng_of

from jaxsfm.colmap.two_views import ImageKeypoints, Inliers
from jaxsfm.io.pairs import exhaustive_pairs
from jaxsfm.sfm import mapper_matches as module
from jaxsfm.sfm.mapper_matches import (
    GRID,
    LEAST_PER_PAIR,
    PER_IMAGE,
    PER_PAIR,
    mapper_matches,
    quotas,
)

SIZE = (640, 480)


def drawn(seed: int, points: int, *, images: int = 4, seen: float = 0.6) -> Inliers:
    """Points that each image shows with the probability `seen`, with all their matches and a tenth
    of false ones. Each image numbers its keypoints in an order of its own."""
    rng = rng_of(seed)
    names = [f"{k}.jpg" for k in range(images)]
    shows = rng.uniform(size=(images, points)) < seen
    xy = rng.uniform(-0.5, np.asarray(SIZE) - 0.5, (images, points, 2))
    order = [rng.permutation(points) for _ in names]
    number = [np.argsort(each) for each in order]
    keypoints = {
        name: ImageKeypoints(xy[k][order[k]].astype(np.float32), SIZE)
        for k, name in enumerate(names)
    }
    matches = {}
    for a in range(images):
        for b in range(a + 1, images):
            both = np.flatnonzero(shows[a] & shows[b])
            rows = np.stack([number[a][both], number[b][both]], 1)
            false = rng.uniform(size=len(rows)) < 0.1
            rows[false, 1] = np.roll(rows[false, 1], 1)
            if len(rows):
                matches[names[a], names[b]] = rows
    return Inliers(keypoints, matches)


def as_sets(matches: dict) -> dict:
    return {pair: set(map(tuple, rows.tolist())) for pair, rows in matches.items()}


@pytest.fixture
def quota(monkeypatch):
    """Sets how many matches each pair keeps at least."""

    def to(count: int) -> None:
        monkeypatch.setattr(module, "PER_PAIR", count)
        monkeypatch.setattr(module, "LEAST_PER_PAIR", count)

    return to


@pytest.mark.parametrize(("seed", "per_pair"), [(0, 10), (1, 40), (2, 0), (3, 1), (4, 1000)])
def test_the_matches_are_those_that_loops_choose(seed, per_pair, monkeypatch, quota):
    monkeypatch.setattr(module, "BLOCK", 150)  # of 800 keypoints
    quota(per_pair)
    inliers = drawn(seed, 200)
    want = oracle(inliers.keypoints, inliers.matches, GRID, per_pair)
    assert as_sets(mapper_matches(inliers)) == want


def test_images_with_many_pairs_keep_fewer_matches_of_each():
    """A pair keeps what the image with fewer pairs needs."""
    star = [("a", name) for name in "bcdef"]
    assert quotas(star).tolist() == [PER_PAIR] * 5
    crowd = exhaustive_pairs([str(k) for k in range(26)])
    assert set(quotas(crowd)) == {PER_IMAGE // 25} and LEAST_PER_PAIR < PER_IMAGE // 25 < PER_PAIR
    assert quotas([*crowd, ("0", "z")])[-1] == PER_PAIR
    large = exhaustive_pairs([str(k) for k in range(200)])
    assert set(quotas(large)) == {LEAST_PER_PAIR} and len(quotas([])) == 0


def test_every_pair_keeps_what_it_was_promised_or_all_that_it_has(quota):
    quota(60)
    inliers = drawn(5, 900, seen=0.5)
    weak = ("0.jpg", "1.jpg")
    inliers.matches[weak] = inliers.matches[weak][:37]
    found = mapper_matches(inliers)
    for pair, rows in inliers.matches.items():
        assert len(found[pair]) >= min(60, len(rows))
        assert set(map(tuple, found[pair].tolist())) <= set(map(tuple, rows.tolist()))
    assert sum(map(len, found.values())) < 0.6 * sum(map(len, inliers.matches.values()))


def test_pairs_with_few_matches_keep_all_of_them():
    inliers = drawn(6, PER_PAIR)
    assert as_sets(mapper_matches(inliers)) == as_sets(inliers.matches)


def test_matches_are_taken_from_all_parts_of_both_images(quota):
    """Most matches lie in one corner of the first image, or of the second one."""
    rng = rng_of(7)
    crowd, sparse = 2000, 60

    def spread(count: int) -> np.ndarray:
        return rng.uniform(0, np.asarray(SIZE) - 1, (count, 2))

    def corner(count: int) -> np.ndarray:
        return rng.uniform(0, 20, (count, 2))

    one = np.concatenate([corner(crowd), spread(crowd), spread(sparse)])
    other = np.concatenate([spread(crowd), corner(crowd), spread(sparse)])
    keypoints = {n: ImageKeypoints(xy, SIZE) for n, xy in (("a", one), ("b", other))}
    rows = np.tile(np.arange(2 * crowd + sparse)[:, None], (1, 2))
    quota(200)
    found = mapper_matches(Inliers(keypoints, {("a", "b"): rows}))["a", "b"]
    assert len(found) == 200
    assert (found[:, 0] >= 2 * crowd).sum() > 0.9 * sparse


def test_matches_that_third_images_confirm_come_first(quota):
    """Of the matches of two images, a fifth is confirmed by a third image."""
    xy = np.tile([320.0, 240.0], (500, 1))
    keypoints = {name: ImageKeypoints(xy, SIZE) for name in "abc"}
    same = np.tile(np.arange(500)[:, None], (1, 2))
    matches = {("a", "b"): same, ("a", "c"): same[:100], ("b", "c"): same[:100]}
    quota(100)
    found = mapper_matches(Inliers(keypoints, matches))
    assert all(set(rows[:, 0]) == set(range(100)) for rows in found.values())


def test_the_order_of_images_pairs_and_matches_has_no_effect(quota):
    quota(30)
    inliers = drawn(8, 300)
    rng = rng_of(9)
    turned = Inliers(
        dict(reversed(inliers.keypoints.items())),
        {pair: rng.permutation(rows) for pair, rows in reversed(inliers.matches.items())},
    )
    found, again = (mapper_matches(each) for each in (inliers, turned))
    assert as_sets(found) == as_sets(again)


def test_nothing_to_map_is_nothing():
    empty = ImageKeypoints(np.zeros((0, 2), np.float32), SIZE)
    assert mapper_matches(Inliers({"a": empty, "b": empty}, {})) == {}
