"""Which models of a run show places of their own, and which photos are settled then."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_runs import Mapped, Matched, Photos, Stages, image

from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairCounts
from jaxsfm.runs import mapping_looks, places
from jaxsfm.runs.mapping_looks import map_in_looks
from jaxsfm.runs.places import BRIDGES, ONE_PLACE, bridges, places_of_their_own
from jaxsfm.sfm.two_photos.matched import HALF_SURE, POWER


@dataclasses.dataclass
class FakeJob:
    """What is asked of a job here."""

    config: Any = None
    engine: Any = None
    progress: bool = True

    def here(self) -> "FakeJob":
        return dataclasses.replace(self, progress=False)


LIMIT = HALF_SURE * (ONE_PLACE / (1 - ONE_PLACE)) ** (1 / POWER)
"""The evidence of a pair that is right with the probability `ONE_PLACE`."""


def counts(**inliers: int) -> dict[Pair, PairCounts]:
    """Counts of pairs of photos with names of one letter."""
    return {
        (name[0], name[1]): PairCounts(n, 1, 100, 0, Status.VERIFIED) for name, n in inliers.items()
    }


def run(*models: str, doubted: bool = False) -> Any:
    """A run whose models have these photos."""
    own = [set(model) for model in models]
    return SimpleNamespace(checked_models=lambda: own, doubted=lambda: doubted)


def apart(
    monkeypatch, mapped: Any, tried: dict[Pair, PairCounts], evidence: dict[Pair, float]
) -> tuple[list[str], list[Pair]]:
    """The models with places of their own, and which pairs were matched to find out."""
    matched: list[Pair] = []
    images = {n: ImageFile(name=n, path=Path(n), size=(4, 3), sha256=n) for n in "abcdef"}

    def match_pairs(job, images, pairs, seconds):
        assert not job.progress  # a trial of a few pairs is no news
        matched.extend(pairs)

    monkeypatch.setattr(places, "match_pairs", match_pairs)
    monkeypatch.setattr(places, "_evidence", lambda job, images, pair: evidence.get(pair, 0.0))
    job: Any = FakeJob()
    own = places_of_their_own(job, images, mapped, tried, {})
    return ["".join(sorted(model)) for model in own], matched


@pytest.mark.parametrize(
    ("evidence", "own"), [(LIMIT - 1, ["ab", "cd", "ef"]), (LIMIT + 1, ["ef"])]
)
def test_two_models_show_one_place_if_a_pair_between_them_is_probably_right(
    monkeypatch, evidence, own
):
    tried = counts(ab=900, cd=800, ac=30, bd=40, be=20, cf=20)
    pairs = [("a", "c"), ("b", "d"), ("b", "e"), ("c", "f")]
    found = apart(monkeypatch, run("ab", "cd", "ef"), tried, {("a", "c"): evidence})
    assert found == (own, pairs)


@pytest.mark.parametrize(
    "mapped",
    [run(), run("ab"), run("ab", "cd", doubted=True), run("abc", "cd")],
    ids=["no model", "one", "in doubt", "a photo in both"],
)
def test_without_two_sure_models_apart_nothing_is_matched_and_nothing_is_said(monkeypatch, mapped):
    assert apart(monkeypatch, mapped, counts(ac=30), {}) == ([], [])


def test_models_without_a_tried_pair_between_them_show_different_places(monkeypatch):
    assert apart(monkeypatch, run("ab", "cd"), counts(ab=900, cd=800), {}) == (["ab", "cd"], [])


def test_bridges_are_pairs_between_two_models():
    tried = counts(ab=9, ac=3, bd=5, xc=99, ae=4, ce=9)
    between = [("a", "c"), ("b", "d")]
    assert bridges(["ab", "cd"], tried) == between
    assert bridges(["ab", "cd", "ef"], tried) == [("a", "c"), ("a", "e"), ("b", "d"), ("c", "e")]


def test_two_models_have_a_limited_number_of_bridges_whatever_lies_between_others():
    """Parts of one place are not hidden by stronger pairs with a third one."""
    many = {(f"a{k:02}", "y"): PairCounts(k, 1, 100, 0, Status.VERIFIED) for k in range(20)}
    weak = ("y", "z")
    tried = many | {weak: PairCounts(1, 1, 100, 0, Status.VERIFIED)}
    found = bridges([[a for a, _ in many], ["y"], ["z"]], tried)
    assert found == [*((f"a{k:02}", "y") for k in range(20 - BRIDGES, 20)), weak]


@pytest.mark.parametrize(
    ("found", "evidence", "whole", "unsettled"),
    [
        (Mapped(True, 20, many_lost=True, places=2), 0.0, None, ""),
        (Mapped(True, 20, many_lost=True, places=2), LIMIT + 1, True, "a"),
        # Models 0 and 1 show one place. The best one is settled.
        (Mapped(True, 20, many_lost=True, places=3), LIMIT + 1, False, "1a 1b"),
        (Mapped(True, 20, many_lost=True, in_no_model="many", places=2), 0.0, False, "a"),
        (Mapped(True, 20, many_lost=True), 0.0, True, "a"),
        (Mapped(True, 20, few_apart=True, places=2), 0.0, False, "a"),  # few are unsettled
    ],
)
def test_photos_of_places_of_their_own_need_no_second_look(
    monkeypatch, tmp_path, found, evidence, whole, unsettled
):
    monkeypatch.setattr(mapping_looks, "find_turned", lambda *_: {})
    monkeypatch.setattr(mapping_looks, "match_again", lambda *_: Matched("again"))
    monkeypatch.setattr(Photos, "sky_masks", {"a": b""})
    monkeypatch.setattr(places, "match_pairs", lambda *_: None)
    monkeypatch.setattr(places, "_evidence", lambda *_: evidence)
    monkeypatch.setattr(
        Matched, "counts", counts() | {("0a", "1b"): PairCounts(*[30] * 4, Status.VERIFIED)}
    )
    images = {name: image(name) for name in "ab"}
    photos: Any = Photos(images, FakeJob(SimpleNamespace(checked=True)))
    made = {"": found, "again": Mapped(True, 40)}
    stages: Any = Stages(made, [*images.values()], SimpleNamespace(path=tmp_path))
    looks = map_in_looks(photos, Matched(""), stages)  # pyright: ignore[reportArgumentType]
    assert looks.looks is not None and looks.looks.whole == bool(whole)
    assert list(looks.looks.photos) == unsettled.split()
    assert looks.mapped is (found if whole is None else made["again"])
