"""Whether models are right: a judgement beside reference poses, and what a run says of itself.

A model is taken apart into groups of photos that have their reference poses up to one similarity
(`jaxsfm.sfm.check.common_places`). A right model is one group. A courtyard that was taken for its
own mirror, or a tower that was folded onto one face, has several groups.

The limits of a group separate two sizes of error. Repeats of architecture are 30 to 180 degrees or
at least an eighth of the cameras' extent apart, and two groups that are further apart than twice
the limits cannot be one group. Right models of the Strecha sets, made from photos of 800 pixels
without refinement, have mean errors of 0.2 % of the extent and 0.5 degrees or less.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from jaxsfm.colmap.poses import Poses
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.verdict import model_verdicts
from jaxsfm.sfm.check.common_places import MIN_PHOTOS, SAME_SHARE, groups
from jaxsfm.sfm.evaluation import pair_names

WHOLE = 0.9
"""A right model is whole if it has at least this share of the photos, as for the mapper
(`jaxsfm.colmap.mapper.MISSING`)."""
Outcome = Literal["right", "split", "wrong, noticed", "wrong, not noticed", "no model"]
OUTCOMES: tuple[Outcome, ...] = (
    "right",
    "split",
    "wrong, noticed",
    "wrong, not noticed",
    "no model",
)
"""Right: every model is right (`SAME_SHARE`), and the largest is whole. Split: every model is
right, but the largest is not whole, so only connections are missing. Wrong: a model is not right;
the run said so (`doubt`), or it did not."""


class Judgement(NamedTuple):
    """The outcome of one reconstruction."""

    outcome: Outcome
    groups: list[list[int]]
    """The sizes of the groups of each model that was judged, the largest first."""


def doubt(report: RunReport | None) -> str:
    """What a run says against its own models; empty if it presents them as right.

    Photos that are missing, and groups of photos that no pair joins, say nothing against the photos
    that are in a model. What a run says is the verdict on its worst model. COLMAP says nothing.

    Args:
      report: None for a method without a report.
    """
    if report is None:
        return ""
    verdicts = model_verdicts(report.checked)
    worst_first = (
        v.headline for colour in ("red", "amber") for v in verdicts if v.colour == colour
    )
    return next(worst_first, "")


def judge(models: Sequence[Poses], truth: Poses, *, noticed: bool) -> Judgement:
    """The outcome of a reconstruction.

    Args:
      models: the poses of each model, the one with most photos first.
      truth: the reference poses of all photos that should be registered.
      noticed: whether the run says that its model may be wrong.
    """
    judged = [model for model in models if len(pair_names(model, truth)) >= MIN_PHOTOS]
    sizes = [[len(group) for group in groups(model, truth)] for model in judged]
    return Judgement(outcome_of(sizes, len(truth), noticed=noticed), sizes)


def is_right(sizes: Sequence[int]) -> bool:
    """Whether a model is right that is made of groups of these sizes, the largest first."""
    return sizes[0] >= SAME_SHARE * sum(sizes)


def outcome_of(sizes: Sequence[Sequence[int]], photos: int, *, noticed: bool) -> Outcome:
    """The outcome of a reconstruction.

    Args:
      sizes: those of the groups of each model that is judged, the largest first.
      photos: the number of photos that should be registered.
      noticed: whether the run says that its model may be wrong.
    """
    if not sizes:
        return "no model"
    if not all(map(is_right, sizes)):
        return "wrong, noticed" if noticed else "wrong, not noticed"
    return "right" if sum(sizes[0]) >= WHOLE * photos else "split"
