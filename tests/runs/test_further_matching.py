"""Laws of further passes over photos that found no place."""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pair_results import counts, job_and_images, result

from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.store import Store
from jaxsfm.runs import further_matching
from jaxsfm.runs.further_matching import match_further, pairs_to_rematch, without_matches
from jaxsfm.sfm.limits import REGISTER
from jaxsfm.sfm.two_photos.matching_pass import PhotoPair
from jaxsfm.sfm.two_photos.pair_passes import HOPELESS


def test_the_strongest_pairs_with_placed_photos_are_matched():
    tried = {
        ("a", "lost"): counts(0, 90),
        ("b", "lost"): counts(40),
        ("c", "lost"): counts(0, 80),
        ("d", "lost"): counts(30),
        ("lost", "other"): counts(900),
        ("a", "b"): counts(900),
    }
    tried |= {("blank", "lost"): counts(0, 25), ("bare", "lost"): counts(0, 26)}
    find = functools.partial(pairs_to_rematch, counts=tried, least=26)
    found = find(["lost"], ["a", "b", "c", "d"])
    assert found == [("b", "lost"), ("d", "lost"), ("a", "lost")] and REGISTER.partners == 3
    both = find(["other", "lost"], ["a", "lost", "other"])
    assert both == [("lost", "other"), ("a", "lost")]  # each pair once
    assert find(["lost"], ["x"]) == []
    assert find(["lost"], ["blank", "bare"]) == [("bare", "lost")]  # a blank photo shows nothing


@pytest.fixture
def looked(monkeypatch):
    """The pairs that were matched; the significance of a pair is looked up."""
    done: list[tuple[str, str]] = []

    def of(
        significance: dict[tuple[str, str], float], damaged: str = "", scale: float = 0.1
    ) -> list:
        def features(_: object, image: ImageFile, *, config: object) -> SimpleNamespace:
            if image.name == damaged:
                raise ImageError(f"{image.name}: damaged")
            return SimpleNamespace(image=image, scale=(scale, scale))

        def looks(given: PhotoPair, both: Any, *, worth_further: float):
            assert worth_further == HOPELESS and given.seed == 7
            pair = (both[0].image.name, both[1].image.name)
            done.append(pair)
            chosen = [SimpleNamespace(result=result(pair))]
            return SimpleNamespace(chosen=chosen, significance=significance[pair])

        monkeypatch.setattr(further_matching, "image_features", features)
        monkeypatch.setattr(further_matching, "match_in_passes", looks)
        return done

    return of


def test_only_matches_with_enough_significance_count_and_none_of_photos_that_cannot_be_decoded(
    looked,
):
    job, images = job_and_images()
    significance = {("a", "b"): 61.0, ("a", "c"): 59.0}
    done = looked(significance, damaged="d")
    found = match_further(job, images, [*significance, ("a", "d")])
    assert [*found] == [("a", "b")] and found["a", "b"].num_inliers == 5
    assert done == [*significance]


def test_points_that_several_passes_saw_count_once(looked):
    """One match for each fine cell, which is 8 working pixels wide; the five lie 2 pixels apart."""
    job, images = job_and_images()
    assert job.config.fine_stride == 8
    looked({("a", "b"): 61.0}, scale=0.5)
    assert match_further(job, images, [("a", "b")])["a", "b"].num_inliers == 3
    looked({("a", "b"): 61.0}, scale=1.0)
    assert match_further(job, images, [("a", "b")])["a", "b"].num_inliers == 2


def test_what_was_matched_further_is_kept_and_what_was_unlikely_too(looked, tmp_path):
    job, images = job_and_images()
    significance = {("a", "b"): 400.0, ("a", "c"): 0.0}
    done = looked(significance)
    identity = {"images": {name: image.sha256 for name, image in images.items()}, "config": {}}
    store = Store(tmp_path, identity)
    first = match_further(job, images, significance, store=store)
    again = match_further(job, images, significance, store=Store(tmp_path, identity))
    assert done == [*significance] and [*first] == [*again] == [("a", "b")]
    np.testing.assert_array_equal(first["a", "b"].keypoints1, again["a", "b"].keypoints1)
    elsewhere = Store(tmp_path, {**identity, "config": {"max_rectified_planes": 1}})
    match_further(job, images, significance, store=elsewhere)
    assert len(done) == 4


def test_a_pair_without_matches_has_its_counts_of_tentative_matches():
    bare = without_matches(result(("a", "b")))
    assert bare.num_inliers == 0 == len(bare.homographies) == len(bare.cells)
    assert bare.num_tentative == 60 and bare.status == Status.NO_PLANE
