"""Laws of looks at single planes: which are looked at, and what their matches are as one."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from strategies import rng_of

from jaxsfm.config import preset
from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairResult
from jaxsfm.sfm.two_photos import further_passes
from jaxsfm.sfm.two_photos.further_passes import SIZES, match_planes_rectified
from jaxsfm.sfm.two_photos.matching_pass import BY_CHANCE, MatchingPass, PhotoPair
from jaxsfm.sfm.two_photos.pair_passes import as_one, one_match_each

IMAGES: Any = ("photo 0", "photo 1")


@pytest.fixture
def looked_at(monkeypatch):
    """The planes and sizes that are looked at; each look has the significance that `seen` says."""
    log: list[tuple[int, int]] = []  # planes and sizes
    seen: dict[tuple[int, int], float] = {}

    def closer(_, plane: int, *, size: int) -> Any:
        log.append((plane, size))
        value = seen.get((plane, size))
        return None if value is None else SimpleNamespace(significance=value, at=(plane, size))

    monkeypatch.setattr(further_passes, "match_rectified", closer)

    def looks(
        significance: list[float], most: int = 4, whole: float = 1.0, **found: float
    ) -> list[tuple[int, int]]:
        log.clear()
        seen.clear()
        seen.update({tuple(map(int, key[1:].split("_"))): e for key, e in found.items()})  # type: ignore[misc]
        best: Any = SimpleNamespace(
            significance=whole,
            plane_significance=np.asarray(significance),
            on_planes=lambda planes, *_: int(planes[0]),
        )
        config = dataclasses.replace(preset("default"), max_rectified_planes=most)
        weights: Any = None
        chosen = match_planes_rectified(PhotoPair(IMAGES, weights, config, 0), best)
        assert chosen.taken == len([at for at in log if at in seen])
        return [each.at for each in chosen.confirmed]  # type: ignore[attr-defined]

    return SimpleNamespace(passes=looks, log=log)


def test_the_strongest_planes_are_matched_and_none_that_may_be_chance(looked_at):
    assert looked_at.passes([20.0, 90.0, 14.9, 40.0]) == []
    assert looked_at.log == [(1, SIZES[0]), (3, SIZES[0]), (0, SIZES[0])]
    looked_at.passes([20.0, 90.0, 14.9, 40.0], most=2)
    assert looked_at.log == [(1, SIZES[0]), (3, SIZES[0])]
    assert preset("default").max_rectified_planes == preset("robust").max_rectified_planes == 4


def test_a_plane_counts_if_it_is_at_least_as_strong_as_seen_from_one_place(looked_at):
    assert looked_at.passes([30.0, 50.0], p0_600=30.0, p1_600=49.9) == [(0, 600)]
    assert (1, 1000) not in looked_at.log  # what is not confirmed is not matched again


def test_a_confirmed_plane_is_seen_larger_and_the_stronger_pass_counts(looked_at):
    assert looked_at.passes([30.0], p0_600=80.0, p0_1000=90.0) == [(0, 1000)]
    assert looked_at.passes([30.0], p0_600=80.0, p0_1000=70.0) == [(0, 600)]
    assert looked_at.passes([30.0], p0_600=80.0, p0_1000=20.0) == [(0, 600)]
    assert looked_at.passes([30.0], p0_600=80.0) == [(0, 600)]


def test_the_passes_count_if_one_is_as_strong_as_the_pass_that_led_to_them(looked_at):
    both = {"p0_600": 60.0, "p1_600": 80.0}
    assert looked_at.passes([30.0, 40.0], whole=80.0, **both) == [(1, 600), (0, 600)]
    assert looked_at.passes([30.0, 40.0], whole=80.1, **both) == []


def result(rng: np.random.Generator, planes: int, matches: int) -> PairResult:
    return PairResult(
        pair=("a", "b"),
        cells=np.stack([rng.permutation(900)[:matches] for _ in range(2)], 1).astype(np.int32),
        keypoints0=rng.uniform(0, 300, (matches, 2)).astype(np.float32),
        keypoints1=rng.uniform(0, 300, (matches, 2)).astype(np.float32),
        plane=rng.integers(0, planes, matches).astype(np.int32),
        homographies=rng.normal(size=(planes, 3, 3)),
        num_tentative=2 * matches,
        num_dropped=1,
        status=Status.VERIFIED,
    )


def test_the_matches_of_several_passes_stay_on_their_planes_and_keep_their_own_cells():
    rng = rng_of(7)
    several = [result(rng, planes, 40 + planes) for planes in (2, 1, 3)]
    whole = as_one(several)
    np.testing.assert_array_equal(
        whole.keypoints1, np.concatenate([each.keypoints1 for each in several])
    )
    own = np.concatenate([each.homographies[each.plane] for each in several])
    np.testing.assert_array_equal(whole.homographies[whole.plane], own)
    assert whole.cells.dtype == np.int32 and whole.num_tentative == 2 * whole.num_inliers
    for side in whole.cells.T:
        assert len(np.unique(side)) == whole.num_inliers


def test_one_pass_is_as_it_was():
    only = result(rng_of(8), 2, 30)
    assert as_one([only]) is only


def test_a_square_of_either_photo_keeps_its_first_match():
    xy0 = np.float32([[1, 1], [3.9, 3.9], [4.1, 1], [20, 20], [30, 30]])
    xy1 = np.float32([[1, 1], [90, 90], [50, 50], [7.9, 1], [8.1, 1]])
    found = dataclasses.replace(result(rng_of(9), 2, 5), keypoints0=xy0, keypoints1=xy1)
    kept = one_match_each(found, (4.0, 8.0))
    np.testing.assert_array_equal(kept.keypoints0, xy0[[0, 2, 4]])
    np.testing.assert_array_equal(kept.keypoints1, xy1[[0, 2, 4]])
    np.testing.assert_array_equal(kept.cells, found.cells[[0, 2, 4]])
    np.testing.assert_array_equal(kept.plane, found.plane[[0, 2, 4]])
    assert len(kept.homographies) == 2 and kept.num_tentative == 10


def test_a_plane_must_grow_by_what_is_due_to_chance(monkeypatch):
    """The significance of a pass is what its planes have beyond chance."""
    one = result(rng_of(10), 1, 30)
    best = MatchingPass(one, np.asarray([100.0]))
    weights: Any = None
    photo = ImageFile(name="a", path=Path("a"), size=(400, 300), sha256="0")
    for significance, counts in ((100.0 + BY_CHANCE, 1), (99.9 + BY_CHANCE, 0)):
        seen = MatchingPass(one, np.asarray([significance]))
        monkeypatch.setattr(further_passes, "match_rectified", lambda *_, seen=seen, **__: seen)
        pair = PhotoPair((photo, photo), weights, preset("default"), 0)
        found = match_planes_rectified(pair, best)
        assert len(found.confirmed) == counts and found.taken == 1 + counts
