"""Whether models are right: a judgement beside reference poses, and what a run says of itself.

A model is taken apart into groups of photos that have their reference poses up to one similarity
(`jaxsfm.sfm.check.common_places`). A right model is one group. A courtyard that was taken for its
own mirror, or a tower that was folded onto one face, has several groups.

The limits of a group separate two sizes of error. Repeats of architecture are 30 to 180 degrees or
at least an eighth of the cameras' extent apart, and two groups that are further apart than twice
the limits cannot be one group. Right models of the Strecha sets, made from photos of 800 pixels
without refinement, have mean errors of 0.2 % of the extent and 0.5 degrees or less.

There are other judges for sets without exact poses. All of them divide a model's photos into groups
that are right in themselves, the largest first.

* Rotations: photos are turned as in the reference, up to the one rotation between the two worlds
  that most of the model's photos agree on. For a reference whose positions are too rough. Groups
  that were joined wrongly are turned against each other, and only one of them is right.
* Ring: they stand at equal angles around what they show, in the order of their names. For photos
  without reference poses that were taken on a way around something.
"""

from collections.abc import Collection, Sequence
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsfm.colmap.poses import Poses
from jaxsfm.io.pair_selection import natural
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.verdict import model_verdicts
from jaxsfm.sfm.check.common_places import MIN_PHOTOS, SAME_SHARE, groups
from jaxsfm.sfm.evaluation import pair_names
from jaxsfm.sfm.view_graph import rotation_angle_deg

Judge = Literal["places", "rotations", "ring"]
WHOLE = 0.9
"""A right model is whole if it has at least this share of the photos, as for the mapper
(`jaxsfm.colmap.mapper.MISSING`)."""
Outcome = Literal[
    "right", "split", "wrong, noticed", "wrong, not noticed", "no model", "not judged"
]
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
RIGHT_DEG = 10.0
"""A photo's rotation may be off by so much: the reference of *statue* has one camera for all photos
of a photo site, and repeated sides of a building are 90 or 180 degrees apart."""
PLACE_DEG = 20.0
"""A camera of a group may stand so far from its place on the ring. In right models of *cup* no
photo is more than 16 degrees out of its place, and its print repeats after more than 100."""
STEP_DEG = 7.0
"""The angle between neighbours may be so far from that of equal steps. In right models of *cup*, it
is up to 5.6 degrees off. Where a model goes back, it is 11 degrees off, or more."""
STEPS_SHARE = 0.9
"""At least this share of the steps between neighbours is right in a ring. This alone would not do:
a ring that is cut and joined at two wrong places has two wrong steps."""


class Judgement(NamedTuple):
    """The outcome of one reconstruction."""

    outcome: Outcome
    groups: list[list[int]]
    """The sizes of the groups of each model that was judged, the largest first."""
    right: int | None
    """The number of different photos in the largest groups of right models; None: not judged."""


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


def judge(
    models: Sequence[Poses],
    truth: Poses | None,
    *,
    noticed: bool,
    how: Judge = "places",
    names: Collection[str] = (),
) -> Judgement:
    """The outcome of a reconstruction. Models of too few photos are not judged.

    Args:
      models: the poses of each model, the one with most photos first.
      truth: the reference poses of all photos that should be registered; the judge of rings needs
        none.
      noticed: whether the run says that its model may be wrong.
      names: of all photos on the ring.
    """
    if how == "ring":
        order = sorted(names, key=natural)
        photos, divided = len(order), [ring_groups(model, order) for model in models]
    elif truth is None:
        return Judgement("not judged", [], None)
    else:
        divide = groups if how == "places" else rotation_groups
        large = [model for model in models if len(pair_names(model, truth)) >= MIN_PHOTOS]
        photos, divided = len(truth), [divide(model, truth) for model in large]
    divided = [each for each in divided if sum(map(len, each)) >= MIN_PHOTOS]
    sizes = [[len(group) for group in each] for each in divided]
    good = [each for each, own in zip(divided, sizes, strict=True) if _is_right(own)]
    right = len({name for each in good for name in each[0]})
    return Judgement(_outcome(sizes, photos, noticed), sizes, right)


def _is_right(sizes: Sequence[int]) -> bool:
    """Whether a model is right that is made of groups of these sizes, the largest first."""
    return sizes[0] >= SAME_SHARE * sum(sizes)


def _outcome(sizes: Sequence[Sequence[int]], photos: int, noticed: bool) -> Outcome:
    """The outcome for groups of these sizes, of a set with so many photos."""
    if not sizes:
        return "no model"
    if not all(map(_is_right, sizes)):
        return "wrong, noticed" if noticed else "wrong, not noticed"
    return "right" if sum(sizes[0]) >= WHOLE * photos else "split"


def rotation_groups(model: Poses, truth: Poses) -> list[list[str]]:
    """The photos of a model that are turned rightly, and each of the others alone."""
    names, off = differences(model, truth)
    right = right_photos(names, off)
    return [right, *([name] for name in names if name not in right)]


def differences(model: Poses, truth: Poses) -> tuple[list[str], np.ndarray]:
    """How far photos disagree on the rotation between the two worlds.

    Returns:
      the photos of the model that have a reference pose, sorted; float64 (n, n), for each two of
      them the angle between the rotations that they say, degrees.
    """
    names = pair_names(model, truth)
    ours = sorted(names)
    said = [model[name].rotation.T @ truth[names[name]].rotation for name in ours]
    between = np.asarray(said).reshape(-1, 3, 3)
    return ours, rotation_angle_deg(between[:, None], between[None])


def right_photos(names: list[str], off: np.ndarray) -> list[str]:
    """The right ones of some photos, in their order. Arguments are what `differences` returns.

    The rotation between the two worlds is that of the photo that most photos agree with; of equal
    ones, the first.
    """
    if not names:
        return []
    agree = off < RIGHT_DEG
    return [name for name, right in zip(names, agree[agree.sum(1).argmax()], strict=True) if right]


def ring_groups(model: Poses, order: Sequence[str]) -> list[list[str]]:
    """The photos of a model that are in their places on a ring, and each of the others alone.

    Args:
      order: the names of all photos on the ring, one after the other.
    """
    at = [k for k, name in enumerate(order) if name in model]
    names = [order[k] for k in at]
    if len(names) < MIN_PHOTOS:
        return [[name] for name in names]
    step, angles = 360 / len(order), _angles_deg(model, names)
    best: list[str] = []
    for direction in (1, -1):
        off = direction * angles - step * np.asarray(at)
        inside = np.abs(_wrapped(off[:, None] - off)) <= PLACE_DEG
        member = inside[inside.sum(1).argmax()]
        steps_right = np.abs(_wrapped(np.diff(off))) <= STEP_DEG
        if steps_right.mean() >= STEPS_SHARE and member.sum() > len(best):
            best = [name for name, within in zip(names, member, strict=True) if within]
    others = [[name] for name in names if name not in best]
    return [best, *others] if best else others


def _wrapped(deg: np.ndarray) -> np.ndarray:
    """Angles from -180 to below 180 degrees."""
    return (deg + 180) % 360 - 180


def _angles_deg(model: Poses, names: Sequence[str]) -> np.ndarray:
    """The angles of cameras around what they look at, float64 (n,), degrees.

    The axis is that about which most rotations between two cameras turn. It goes through the point
    that the optical axes come nearest to.
    """
    rotations = np.stack([model[name].rotation for name in names])
    centres = np.stack([model[name].centre for name in names])
    first, second = np.triu_indices(len(names), 1)
    between = rotations[second].transpose(0, 2, 1) @ rotations[first]
    turns = Rotation.from_matrix(between).as_rotvec()
    axis = np.linalg.svd(turns, full_matrices=False)[2][0]
    ahead = rotations[:, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None]
    middle = np.linalg.lstsq(
        across.reshape(-1, 3), (across @ centres[..., None]).reshape(-1), rcond=None
    )[0]
    right = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
    right /= np.linalg.norm(right)
    x, y = (centres - middle) @ right, (centres - middle) @ np.cross(axis, right)
    return np.degrees(np.arctan2(y, x))
