"""When the verdict is amber because a model could not be refined."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import pytest
from verdicts import check_of

from jaxsfm.config import preset
from jaxsfm.sfm import refined_stage
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refined_stage import check_refined, refine_selected


def refined(*accepted: bool) -> RefinementFigures:
    """A refinement with these passes."""
    passes: list[Any] = [SimpleNamespace(accepted=each) for each in accepted]
    return RefinementFigures(passes=passes, registrations=[])


@pytest.mark.parametrize(
    ("done", "unconfirmed"),
    [
        (refined(False), True),
        (refined(True, False), False),  # only the last pass was taken back
        (refined(True, True), False),
        (refined(), True),  # too few points for a pass
        (None, False),  # switched off, or a photo could not be read
    ],
)
def test_a_model_is_amber_if_no_pass_of_its_refinement_was_accepted(done, unconfirmed):
    check = check_refined(check_of("green"), done)
    assert check is not None and check.unconfirmed == unconfirmed
    assert check.verdict == ("amber" if unconfirmed else "green")
    red = check_refined(check_of("red"), done)
    assert red is not None and red.verdict == "red"


def test_a_model_that_was_not_checked_has_no_verdict_after_its_refinement_either():
    assert check_refined(None, refined(False)) is None


def test_each_model_of_a_run_has_the_check_that_follows_from_its_own_refinement(
    tmp_path, monkeypatch
):
    """The refinement changes the order of the models if another one has most photos then."""
    whole, part = check_of("green"), dataclasses.replace(check_of("green"), apart=[["a", "b"]])
    done = [refined(True), refined(False)]
    monkeypatch.setattr(refined_stage, "read_figures", lambda *_: (done, [1, 0]))
    monkeypatch.setattr(refined_stage, "read_models", lambda *_: ["part", "whole"])
    (tmp_path / "selected.db").touch()
    selected: Any = SimpleNamespace(
        figures=MappingFigures(verdicts={}, attempts=[], checks=[whole, part]),
        database=tmp_path / "selected.db",
        key="",
        models=lambda _: [],
    )
    verified: Any = SimpleNamespace(figures=None)
    given: Any = SimpleNamespace(config=preset("default"), matches={})
    kept: Any = SimpleNamespace(folder=SimpleNamespace(stage=lambda *_: tmp_path))
    made = refine_selected(given, verified, selected, tmp_path / "database.db", kept)
    assert made.mapping.checks == [part, dataclasses.replace(whole, unconfirmed=True)]
