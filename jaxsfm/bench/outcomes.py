"""Whether models are right: a judgement beside reference poses, and what a run says of itself.

A model is taken apart into *groups*: photos that one similarity takes to their reference poses,
within `POSITION_SHARE` and `ROTATION_DEG`. A right model is one group. A courtyard that was taken
for its own mirror, or a tower that was folded onto one face, has several groups, each right in
itself and turned or moved against the others. Mean errors after a fit to all photos do not show
this: the fit lies between the groups, and one wrong photo of twenty hardly changes a mean.

The limits separate two sizes of error. Repeats of architecture are 30 to 180 degrees or at least an
eighth of the cameras' extent apart, and two groups that are further apart than twice the limits
cannot be one group. Right models of the Strecha sets, made from photos of 800 pixels without
refinement, have mean errors of 0.2 % of the extent and 0.5 degrees or less.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from jaxsfm.colmap.poses import Poses
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.verdict import in_words
from jaxsfm.sfm.evaluation import COLLINEAR, Similarity, pair_names, umeyama
from jaxsfm.sfm.view_graph import rotation_angle_deg

POSITION_SHARE = 0.03
"""A right photo's camera centre is off by no more than this share of the extent of all cameras."""
ROTATION_DEG = 5.0
"""A right photo's rotation is off by no more."""
RIGHT_SHARE = 0.95
"""A model is right if its largest group has at least this share of its photos. One photo of twenty
may be misplaced without the model being another one."""
WHOLE = 0.9
"""A right model is whole if it has at least this share of the photos, as for the mapper
(`jaxsfm.colmap.mapper.MISSING`)."""
MIN_PHOTOS = 3
"""Models of fewer photos are not judged: two photos agree with nearly every third."""

Outcome = Literal["right", "split", "wrong, noticed", "wrong, not noticed", "no model"]
OUTCOMES: tuple[Outcome, ...] = (
    "right",
    "split",
    "wrong, noticed",
    "wrong, not noticed",
    "no model",
)
"""Right: every model is right, and the largest is whole. Split: every model is right, but the
largest is not whole, so only connections are missing. Wrong: a model is not right; the run said so
(`doubt`), or it did not."""


class Judgement(NamedTuple):
    """The outcome of one reconstruction."""

    outcome: Outcome
    groups: list[list[int]]
    """The sizes of the groups of each model that was judged, the largest first."""


def extent(truth: Poses) -> float:
    """The largest distance of two camera centres, units of the reference."""
    centres = np.asarray([pose.centre for pose in truth.values()])
    return float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())


def doubt(report: RunReport | None) -> str:
    """What a run says against its own models; empty if it presents them as right.

    Photos that are missing, and groups of photos that no pair joins, say nothing against the photos
    that are in a model. A run has two things to say: that its verdict is amber or red, and that the
    refinement of its best model was taken back, because too few patches agreed with it. COLMAP says
    nothing.

    Args:
      report: None for a method without a report.
    """
    if report is None:
        return ""
    said = [in_words(report.verdict)] if report.verdict in ("amber", "red") else []
    refinement = report.refinement[0] if report.refinement else None
    if refinement and refinement.passes and not refinement.passes[0].accepted:
        said.append("too few patches agreed")
    return "; ".join(said)


def groups(model: Poses, truth: Poses) -> list[list[str]]:
    """The groups of a model's photos (see the module), the largest first.

    The largest group is looked for among the similarities that two photos determine: the rotation
    of the first, and the distance of the two centres. It is then fitted to all its photos, as long
    as this adds photos. The next group is found in the same way among the remaining photos. Photos
    without a reference pose are in no group. The order of photos has no effect, except among
    groups of equal size.
    """
    names = pair_names(model, truth)
    left, found = sorted(names), []
    limit = POSITION_SHARE * extent(truth)
    while left:
        ours, reference = _arrays(model, left), _arrays(truth, [names[name] for name in left])
        member = _largest(ours, reference, limit)
        found.append([name for name, inside in zip(left, member, strict=True) if inside])
        left = [name for name, inside in zip(left, member, strict=True) if not inside]
    return sorted(found, key=lambda group: (-len(group), group))


class _Arrays(NamedTuple):
    rotations: np.ndarray
    """float64 (n, 3, 3), world to camera."""
    centres: np.ndarray
    """float64 (n, 3)."""


def _arrays(poses: Poses, names: Sequence[str]) -> _Arrays:
    chosen = [poses[name] for name in names]
    return _Arrays(np.stack([p.rotation for p in chosen]), np.stack([p.centre for p in chosen]))


def _largest(ours: _Arrays, reference: _Arrays, limit: float) -> np.ndarray:
    """The members of the largest group, bool (n,): always at least one photo.

    Args:
      limit: the largest error of a position, units of the reference.
    """
    best = np.zeros(len(ours.centres), bool)
    best[0] = True
    for first in range(len(best)):
        turn = reference.rotations[first].T @ ours.rotations[first]
        turned = ours.rotations @ turn.T
        upright = rotation_angle_deg(turned, reference.rotations) <= ROTATION_DEG
        if upright.sum() <= best.sum():
            continue
        own = (ours.centres - ours.centres[first]) @ turn.T
        true = reference.centres - reference.centres[first]
        for second in np.flatnonzero(upright):
            length, distance = np.linalg.norm(own[second]), np.linalg.norm(true[second])
            if length == 0 or distance == 0:  # the first photo itself, or one in the same place
                continue
            scale = distance / length
            close = np.linalg.norm(scale * own - true, axis=-1) <= limit
            if (upright & close).sum() > best.sum():
                best = upright & close
    while (fitted := _fitted(ours, reference, best, limit)).sum() > best.sum():
        best = fitted
    return best


def _fitted(ours: _Arrays, reference: _Arrays, member: np.ndarray, limit: float) -> np.ndarray:
    """The photos that agree after a fit to the members; the members if a fit is not determined."""
    source, target = ours.centres[member], reference.centres[member]
    for centres in (source, target):
        spread = np.linalg.svd(centres - centres.mean(0), compute_uv=False)
        if len(centres) < MIN_PHOTOS or spread[1] <= COLLINEAR * spread[0]:
            return member
    fit: Similarity = umeyama(source, target)
    off = fit.scale * ours.centres @ fit.rotation.T + fit.translation - reference.centres
    angle = rotation_angle_deg(ours.rotations @ fit.rotation.T, reference.rotations)
    return (np.linalg.norm(off, axis=-1) <= limit) & (angle <= ROTATION_DEG)


def judge(models: Sequence[Poses], truth: Poses, *, noticed: bool) -> Judgement:
    """The outcome of a reconstruction.

    Args:
      models: the poses of each model, the one with most photos first.
      truth: the reference poses of all photos that should be registered.
      noticed: whether the run says that its model may be wrong.
    """
    judged = [model for model in models if len(pair_names(model, truth)) >= MIN_PHOTOS]
    if not judged:
        return Judgement("no model", [])
    sizes = [[len(group) for group in groups(model, truth)] for model in judged]
    if any(each[0] < RIGHT_SHARE * sum(each) for each in sizes):
        return Judgement("wrong, noticed" if noticed else "wrong, not noticed", sizes)
    return Judgement("right" if sum(sizes[0]) >= WHOLE * len(truth) else "split", sizes)
