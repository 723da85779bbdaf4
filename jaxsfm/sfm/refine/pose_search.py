"""Poses of views that show little of a model: what stands out from what they show beside it.

Of a photo by night, lamps may light a few corners only. Then few of the points that it could show
agree, even at the right pose. But much fewer agree where the photo is turned to the side, and no
pose near the right one shows more. Both are looked at here, for poses that the octaves
(`jaxsfm.sfm.refine.octave_pose`) leave in doubt: a pose first climbs to where the coarsest octave
shows most, and is then compared with poses beside it.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.sfm.refine.fixed_structure import AlignedPoints, FixedStructure
from jaxsfm.sfm.refine.octave_pose import (
    MIN_COUNT,
    OctavePose,
    PoseHypothesis,
    converge,
    follow,
)

DIRECTIONS, REACH = 8, 0.4
"""A step of the climb tries poses that are turned in so many directions, by this share of a patch's
side at the coarsest octave. Alignment finds a point from a quarter of a side off, so poses between
the tried ones are found too."""
MORE = 1.1
"""A pose climbs to another one if so many times as many points agree there."""
MAX_CLIMB = 4
"""The largest number of steps of a climb."""
BESIDE = 2.0
"""The poses beside a pose are turned by so many sides of a patch, to four sides."""
ENOUGH_BESIDE = 0.5
"""A pose beside counts if it could show this share of the points that the pose could show."""
STANDS_OUT = 5.0
"""An octave stands out if so many times as large a share of the points agrees as at any pose beside
it. The coarsest one has to, because on a facade a pose that is off by a window agrees with details
as well: on castle-P19 such a pose has 39 points and 9 beside it at half the size, but 665 and 295
at an eighth.
"""
MIN_PATCHES = 20
"""At the coarsest octave, the points that agree must amount to so many patches without overlap. In
a model with many points, they may lie in a few corners: at a pose of fountain-P11 0010 that is 42
degrees off, 137 points agree and 13 beside it, in 13 patches. At right ones it is 12 to 70."""
ROOM = 2
"""A view is searched around if its coarsest octave has room for so many times `MIN_PATCHES`: 1000
working pixels on the longer side, about. On smaller ones next to no pose could be trusted."""


def search(poses: Sequence[PoseHypothesis], structure: FixedStructure) -> None:
    """Search around poses that have been followed, in place, for what stands out.

    Args:
      poses: of views that are not among those of the structure, followed over all octaves.
    """
    large = [pose for pose in poses if _has_room(pose.view, structure.refinement)]
    if not large:
        return
    moved = _climb(large, structure)
    follow(moved, structure)
    _compare(large, structure)


def _has_room(view: View, refinement: Refinement) -> bool:
    side = _coarsest(refinement) * refinement.patch_side
    return view.size[0] * view.size[1] >= ROOM * MIN_PATCHES * side**2


def _climb(poses: Sequence[PoseHypothesis], structure: FixedStructure) -> list[PoseHypothesis]:
    """Move poses to where the coarsest octave shows most; returns those that have moved, which are
    as if nothing had agreed with them yet."""
    coarsest = _coarsest(structure.refinement)
    way_px = REACH * coarsest * structure.refinement.patch_side
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    ways = way_px * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    climbing, moved = list(poses), dict[PoseHypothesis, None]()
    start = {
        pose: pose.octaves[max(pose.octaves)].view if pose.octaves else pose.view for pose in poses
    }
    for _ in range(MAX_CLIMB):
        if not climbing:
            break
        tried = [
            [
                PoseHypothesis(view=view, own_camera=pose.own_camera)
                for view in [start[pose], *(_turned(start[pose], way) for way in ways)]
            ]
            for pose in climbing
        ]
        converge([each for own in tried for each in own], structure, coarsest)
        higher = []
        for pose, own in zip(climbing, tried, strict=True):
            best = max(own, key=lambda each: each.agreed)
            if best.agreed >= MIN_COUNT and best.agreed > MORE * own[0].agreed:
                start[pose] = pose.view = best.view
                higher.append(pose)
        moved |= dict.fromkeys(higher)
        climbing = higher
    for pose in moved:
        pose.octaves, pose.share = {}, 0.0
    return list(moved)


def _compare(poses: Sequence[PoseHypothesis], structure: FixedStructure) -> None:
    """Say of poses, in place, which of their octaves stands out."""
    side, coarsest = structure.refinement.patch_side, _coarsest(structure.refinement)
    every = [(pose, each) for pose in poses for each in pose.octaves.values()]
    ahead: dict[PoseHypothesis, list[OctavePose]] = {pose: [] for pose in poses}
    for px in sorted({each.octave_px for _, each in every}):
        way_px = BESIDE * px * side
        ways = way_px * np.asarray([[1, 0], [-1, 0], [0, 1], [0, -1]])
        own = [(pose, each) for pose, each in every if each.octave_px == px]
        views = [_turned(each.view, way) for _, each in own for way in ways]
        shown = [seen for _, seen in structure.shown_from(views, px)]
        for k, (pose, each) in enumerate(own):
            if _stands_out(each, shown[k * len(ways) : (k + 1) * len(ways)]):
                ahead[pose].append(each)
    for pose, found in ahead.items():
        pose.searched = True
        ground = next((each for each in found if each.octave_px == coarsest), None)
        if ground is not None and ground.patches >= MIN_PATCHES:
            near_px = ground.octave_px * side
            there = [each for each in found if _apart_px(each, ground) <= near_px]
            pose.stands_out = min(there, key=lambda each: each.uncertainty_px)


def _stands_out(pose: OctavePose, beside: Sequence[AlignedPoints]) -> bool:
    """Whether far more agrees at a pose than at the poses beside it that say something."""
    could = len(pose.points.candidates)
    telling = [seen for seen in beside if len(seen.candidates) >= ENOUGH_BESIDE * could]
    most = max((len(seen.rows) / len(seen.candidates) for seen in telling), default=np.inf)
    return pose.agreed / could >= STANDS_OUT * most


def _apart_px(first: OctavePose, second: OctavePose) -> float:
    """How far apart two poses put the points that the second could show: the median, working
    pixels."""
    points = second.points.candidates
    way = first.view.project(points)[0] - second.view.project(points)[0]
    return float(np.median(np.nan_to_num(np.linalg.norm(way, axis=1), nan=np.inf)))


def _coarsest(refinement: Refinement) -> int:
    """Working pixels per pixel of the coarsest octave."""
    return 2 ** (refinement.weak_octaves - 1)


def _turned(view: View, way: np.ndarray) -> View:
    """A view turned so that what its middle shows moves by (x, y) working pixels."""
    right, down = way / view.focal_px
    turn = Rotation.from_rotvec([-down, right, 0.0]).as_matrix()
    return dataclasses.replace(view, rotation=turn @ view.rotation)
