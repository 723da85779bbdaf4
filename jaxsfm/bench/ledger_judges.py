"""How `bench ledger` judges models: which photos are right, and what the outcome is.

Each judge divides a model's photos into groups that are right in themselves, the largest first. The
outcome follows from the sizes of the groups (`jaxsfm.bench.outcomes.outcome_of`).

* Places: photos of a group have their reference poses up to one similarity.
* Rotations: they are turned as in the reference, up to the one rotation between the two worlds that
  most of the model's photos agree on. For a reference whose positions are too rough. Groups that
  were joined wrongly are turned against each other, and only one of them is right.
* Ring: they stand at equal angles around what they show, in the order of their names. For photos
  without reference poses that were taken on a way around something.
"""

from collections.abc import Collection, Sequence
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsfm.bench.ledger_sets import Judge
from jaxsfm.bench.outcomes import Outcome, is_right, outcome_of
from jaxsfm.colmap.poses import Poses
from jaxsfm.io.pair_selection import natural
from jaxsfm.sfm.check.common_places import MIN_PHOTOS, groups
from jaxsfm.sfm.evaluation import pair_names
from jaxsfm.sfm.view_graph import rotation_angle_deg

LedgerOutcome = Outcome | Literal["not judged", "ended in an error"]
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


class Judged(NamedTuple):
    """What is right in the models of a run."""

    outcome: LedgerOutcome
    right: int | None
    """The number of different photos in the largest groups of right models; None: not judged."""


def judged(
    models: Sequence[Poses], truth: Poses | None, names: Collection[str], how: Judge, noticed: bool
) -> Judged:
    """Judge the models of a run.

    Args:
      models: the poses of each model, the one with most photos first.
      truth: the reference poses of the photos, for other judges than the ring's.
      names: of all photos that the run was given.
      noticed: whether the run says that a model may be wrong.
    """
    if how == "ring":
        order = sorted(names, key=natural)
        divided = [ring_groups(model, order) for model in models]
        return _judged(divided, len(order), noticed)
    if truth is None:
        return Judged("not judged", None)
    # Models of too few photos with a reference pose are not judged.
    large = [model for model in models if len(pair_names(model, truth)) >= MIN_PHOTOS]
    divide = groups if how == "places" else rotation_groups
    return _judged([divide(model, truth) for model in large], len(truth), noticed)


def _judged(divided: Sequence[list[list[str]]], photos: int, noticed: bool) -> Judged:
    """The outcome for models in groups; smaller models than `MIN_PHOTOS` are left out."""
    large = [each for each in divided if sum(map(len, each)) >= MIN_PHOTOS]
    sizes = [[len(group) for group in each] for each in large]
    good = [each for each, own in zip(large, sizes, strict=True) if is_right(own)]
    right = len({name for each in good for name in each[0]})
    return Judged(outcome_of(sizes, photos, noticed=noticed), right)


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
