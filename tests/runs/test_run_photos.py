"""Laws of the matching of a run's photos: at which size, which pairs, and what becomes of them."""

import dataclasses
import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pair_results import counts, job_and_images, result

from jaxsfm.config import preset
from jaxsfm.io import orientation
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, exhaustive_pairs
from jaxsfm.io.store import Store
from jaxsfm.report.run_inputs import RunIdentity
from jaxsfm.runs import run_photos
from jaxsfm.runs.job import Job, MatchedPairs, match_pairs
from jaxsfm.runs.run_photos import LostMatcher, RunPhotos, turned
from jaxsfm.sfm.limits import REGISTER

TRIED = {pair: counts(30) for pair in exhaustive_pairs("abcd")}


def photos_in(folder: Path, names: str = "abcd") -> RunPhotos:
    """The photos of a run that is never computed."""
    unused: Any = None
    job = Job(
        store=Store(folder, {}),
        weights=unused,
        config=preset("default"),
        engine=unused,
        execution=unused,
        seed=7,
    )
    images = {
        name: ImageFile(name=name, path=Path(name), size=(1600, 1200), sha256=name)
        for name in names
    }
    return RunPhotos(
        job=job,
        identity=RunIdentity(version="1", config={}, images={n: n for n in names}),
        images=images,
        pairs=exhaustive_pairs(names),
    )


@pytest.fixture
def looks(monkeypatch) -> list:
    """The job, the pairs and the store of every rectified pass; each gives matches of its pairs."""
    done: list = []

    def match_further(job: Job, images: dict, pairs: Any, *, store: Store) -> dict:
        assert sorted(images) == [*"abcd"]
        done.append((job, list(pairs), store))
        return {pair: result(pair) for pair in done[-1][1]}

    monkeypatch.setattr(run_photos, "match_further", match_further)
    return done


def test_lost_photos_are_matched_at_full_size_with_photos_that_have_a_place(looks, tmp_path):
    match = LostMatcher(photos_in(tmp_path), TRIED)
    for further, planes in ((False, 0), (True, preset("default").max_rectified_planes)):
        found = match({"d"}, {"a", "b"}, set(), further=further)
        job, pairs, store = looks.pop()
        assert [*found] == pairs == [("a", "d"), ("b", "d")]
        assert job.config == dataclasses.replace(preset("default"), max_rectified_planes=planes)
        assert job.store.identity["config"] == preset("default").matching()
        assert store.identity["config"]["max_rectified_planes"] == planes
    assert planes == 4 and not looks


def test_a_preset_without_further_passes_matches_lost_photos_as_they_are_only(looks, tmp_path):
    photos = photos_in(tmp_path)
    job = dataclasses.replace(photos.job, config=preset("paper"))
    match = LostMatcher(dataclasses.replace(photos, job=job), TRIED)
    assert match({"d"}, {"a", "b"}, set(), further=True) == {} and not looks
    assert match({"d"}, {"a", "b"}, set(), further=False) and len(looks) == 1


def test_nothing_is_matched_where_nothing_is_lost_or_nothing_has_a_place(looks, tmp_path):
    for lost, registered in (({}, {*"abcd"}), ({*"abcd"}, {})):
        match = LostMatcher(photos_in(tmp_path), TRIED)
        assert match(lost, registered, set(), further=True) == {}
    assert not looks


@pytest.mark.parametrize("further", [False, True])
def test_no_pair_is_matched_twice(looks, tmp_path, further):
    """A photo that has found a place is a new partner of the others."""
    match = functools.partial(LostMatcher(photos_in(tmp_path), TRIED), further=further)
    found = [*match({"c", "d"}, {"a", "b"}, set())]
    if further:  # one photo at a time
        found += match({"c", "d"}, {"a", "b"}, set())
    assert sorted(found) == [("a", "c"), ("a", "d"), ("b", "c"), ("b", "d")]
    assert [*match({"d"}, {"a", "b", "c"}, set())] == [("c", "d")]
    assert match({"d"}, {"a", "b", "c"}, set()) == {} and len(looks) == 2 + further


def test_further_passes_are_for_the_photo_with_the_strongest_pair_whose_matches_count(
    monkeypatch, tmp_path
):
    """A photo whose pairs are hardly ever right is followed by the next one in the same call."""
    asked = []

    def match_further(job: Job, images: dict, pairs: Any, *, store: Store) -> dict:
        asked.append([*pairs])
        return {pair: result(pair) for pair in asked[-1] if "c" in pair}

    monkeypatch.setattr(run_photos, "match_further", match_further)
    tried = {("a", "c"): counts(5, 90), ("a", "d"): counts(6, 80)}
    match = functools.partial(LostMatcher(photos_in(tmp_path), tried), further=True)
    assert [*match({"c", "d"}, {"a", "b"}, set())] == [("a", "c")]
    assert asked == [[("a", "d")], [("a", "c")]]
    assert match({"c", "d"}, {"a", "b"}, set()) == {} and len(asked) == 2


def test_pairs_that_were_found_to_be_false_are_not_matched(looks, tmp_path):
    match = functools.partial(LostMatcher(photos_in(tmp_path), TRIED), further=True)
    assert [*match({"d"}, {"a", "b", "c"}, {("a", "d")})] == [("b", "d"), ("c", "d")]
    assert match({"d"}, {"a"}, {("a", "d")}) == {}


def test_at_full_size_each_photo_is_matched_with_its_best_partners(monkeypatch, tmp_path):
    """Of equal partners, those with most tentative matches are better."""
    names = "abcdefghijklmn"
    photos = photos_in(tmp_path, names)
    before = {
        pair: counts(abs(names.index(pair[0]) - names.index(pair[1])) // 2, k)
        for k, pair in enumerate(exhaustive_pairs(names))
    }
    asked: dict[str, Any] = {}

    def match(job: Job, images: Any, pairs: list[Pair], seconds: dict) -> tuple[dict, dict]:
        asked.update(config=job.config, pairs=pairs)
        return {pair: counts(99) for pair in pairs}, {}

    monkeypatch.setattr(run_photos, "match_pairs", match)
    found = photos.match_at_full_size(before, {})
    best = set()
    for name in names:
        own = [pair for pair in before if name in pair]
        own.sort(key=lambda pair: (before[pair].num_inliers, before[pair].num_tentative))
        best |= {*own[-REGISTER.partners_without_model :]}
    assert asked["pairs"] == sorted(best) and best < {*before}
    assert found.described == asked["config"] == preset("default")
    assert found.counts == dict.fromkeys(sorted(best), counts(99))


@pytest.mark.parametrize("sideways", ["", "b"])
def test_photos_are_matched_again_if_some_are_turned(monkeypatch, tmp_path, sideways):
    photos, matched = photos_in(tmp_path), MatchedPairs(Any, Any, TRIED)  # type: ignore[arg-type]
    found = {name: turned(photos.images[name], 1) for name in sideways}
    monkeypatch.setattr(run_photos, "find_turned", lambda trials, counts: found)
    asked: list = []

    def match(job: Job, images: Any, pairs: list[Pair], seconds: dict) -> tuple[dict, dict]:
        asked.append({name: image.orientation for name, image in images.items()})
        return {}, {}

    monkeypatch.setattr(run_photos, "match_pairs", match)
    now, again = photos.upright(matched, {})
    if not sideways:
        assert now is photos and again is matched and not asked
        return
    upright = orientation.UPRIGHT
    assert asked == [{"a": upright, "b": 6, "c": upright, "d": upright}]
    assert again.store.identity["orientations"] == now.identity.orientations == {"b": 6}
    assert now.job.store.identity["orientations"] == {"b": 6} and now.pairs == photos.pairs


def test_a_photo_that_cannot_be_decoded_any_more_has_no_counts():
    """Its pairs may have been matched before."""
    pairs = [("a", "b"), ("a", "c"), ("b", "c"), ("c", "d")]
    kept = {pairs[0]: result(pairs[0]), pairs[1]: result(pairs[1])}
    job: Any = SimpleNamespace(
        store=SimpleNamespace(load_matches=kept.get),
        progress=False,
        extract_missing=lambda images: {"b": "gone"},
        match_missing=lambda images, pairs: map(result, pairs),
    )
    found, lost = match_pairs(job, job_and_images()[1], pairs, {})
    assert lost == {"b": "gone"} and [*found] == [("a", "c"), ("c", "d")]
