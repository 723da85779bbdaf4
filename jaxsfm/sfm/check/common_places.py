"""Groups of photos that have the same places in two models.

A model that joins groups of photos in another way than a second model consists of several groups:
one similarity takes the photos of a group to their places in the second model, and different groups
have different similarities. Mean errors after a fit to all photos do not show this: the fit lies
between the groups, and one wrong photo of twenty hardly changes a mean. Below, the second model is
called the reference.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.poses import Poses
from jaxsfm.sfm.evaluation import COLLINEAR, Similarity, pair_names, umeyama
from jaxsfm.sfm.view_graph import rotation_angle_deg

POSITION_SHARE = 0.03
"""A right photo's camera centre is off by no more than this share of the extent of all cameras."""
ROTATION_DEG = 5.0
"""A right photo's rotation is off by no more."""
SAME_SHARE = 0.95
"""Two models have the same places if the largest group has at least this share of the photos. One
photo of twenty may be misplaced without the model being another one."""
MIN_PHOTOS = 3
"""Models of fewer photos are not judged: two photos agree with nearly every third."""


def extent(truth: Poses) -> float:
    """The largest distance of two camera centres, units of the reference."""
    centres = np.asarray([pose.centre for pose in truth.values()])
    return float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())


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
