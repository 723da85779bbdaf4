"""Which photos of a mapped run have a sure place."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import pytest
from fake_runs import image

from jaxsfm.core.types import Status
from jaxsfm.io.pairs import PairCounts
from jaxsfm.runs.run_stages import MappedRun
from jaxsfm.sfm.check.model_check import Alternative, Contradiction, ModelCheck, OtherPlace

SURE = ModelCheck(groups=[["a", "b", "c", "d"]], contradictions=[], other_places=[])


def settled(
    *checks: ModelCheck | None,
    models: tuple[str, ...] = ("abcd", "ef"),
    of: tuple[str, ...] | None = None,
) -> set[str]:
    """The settled photos, if these models count."""
    stage: Any = SimpleNamespace(figures=SimpleNamespace(checks=[*checks]))
    nothing: Any = None
    run = MappedRun(nothing, stage, nothing)
    run.__dict__["photos"] = [set(names) for names in models]  # it would read the models
    return run.settled_photos(None if of is None else [set(names) for names in of])


def test_photos_of_the_best_model_are_settled_but_those_of_which_neighbours_disagree():
    assert settled(SURE, None) == set("abcd")
    apart = dataclasses.replace(SURE, apart=[["a", "b"], ["b", "e"]])
    assert settled(apart, None) == set("cd")
    assert apart.verdict == "amber" and not apart.doubted()
    assert settled(models=()) == set()


def test_if_models_show_places_of_their_own_the_photos_of_each_are_settled():
    assert settled(SURE, SURE, of=("abcd", "ef")) == set("abcdef")
    assert settled(SURE, SURE, of=("ef",)) == set("ef")
    apart = dataclasses.replace(SURE, apart=[["e", "x"]])
    assert settled(SURE, apart, of=("abcd", "ef")) == set("abcdf")


@pytest.mark.parametrize(("places", "whole"), [(False, True), (True, False)])
def test_half_of_the_photos_may_be_unsettled_only_if_the_models_show_places(places, whole):
    """Otherwise a third."""
    figures = SimpleNamespace(checks=[SURE], verdicts={})
    stage: Any = SimpleNamespace(figures=figures, verification=SimpleNamespace(verified={}))
    given: Any = SimpleNamespace(images=[image(name) for name in "abcdef"])
    nothing: Any = None
    run = MappedRun(given, stage, nothing)
    run.__dict__["photos"] = [set("abc")]
    pairs = [("a", "b"), ("a", "d"), ("d", "e")]
    counts = dict.fromkeys(pairs, PairCounts(30, 1, 100, 0, Status.VERIFIED))
    again = run.unsettled(counts, [set("abc")], places=places)
    assert again is not None and again.photos == ["d", "e", "f"]
    assert (again.whole, again.pairs) == (whole, pairs if whole else pairs[1:])


@pytest.mark.parametrize("of", [None, ("abcd", "ef")])
@pytest.mark.parametrize(
    "doubt",
    [
        {"contradictions": [Contradiction(images=["a"], others=["b"], tested=9, contradicted=9)]},
        {
            "other_places": [
                OtherPlace(image="a", pairs=["b"], agreed=9, contradicted=0, rotation_deg=90.0)
            ]
        },
        {"alternative": Alternative(basis="order", images=4, elsewhere=["a"], contradicted=0)},
        {"told_apart": [["a", "b"], ["c", "d"]]},
    ],
)
@pytest.mark.parametrize("which", [0, 1])
def test_no_photo_is_settled_if_anything_else_speaks_against_a_model(doubt, which, of):
    """Also if it is a smaller model."""
    checks = [SURE, SURE]
    checks[which] = dataclasses.replace(SURE, **doubt)
    assert checks[which].doubted() and checks[which].verdict != "green"
    assert settled(*checks, of=of) == set()
