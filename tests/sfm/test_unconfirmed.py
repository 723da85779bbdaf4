"""When the verdict is amber because a model could not be refined."""

from types import SimpleNamespace
from typing import Any

import pytest
from verdicts import check_of

from jaxsfm.sfm.reconstruction import check_refined
from jaxsfm.sfm.refine.passes import RefinementFigures


def refined(*accepted: bool) -> RefinementFigures:
    """A refinement with these passes."""
    passes: list[Any] = [SimpleNamespace(accepted=each) for each in accepted]
    return RefinementFigures(passes=passes, placed=[])


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
