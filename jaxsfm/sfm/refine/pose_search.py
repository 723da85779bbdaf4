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

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.octave_pose import (
    MIN_COUNT,
    OctavePose,
    PoseHypothesis,
    follow,
    settle,
    shown_from,
)

DIRECTIONS, REACH = 8, 0.5
"""A step of the climb tries poses that are turned in so many directions, by this share of a patch's
side at the coarsest octave. Alignment finds a point from a quarter of a side off."""
MORE = 1.1
"""A pose climbs to another one if so many times as many points agree there."""
MAX_CLIMB = 4
"""The largest number of steps of a climb."""
BESIDE = 2.0
"""The poses beside a pose are turned by so many sides of a patch, to four sides."""
STANDS_OUT = 5.0
"""An octave stands out if so many times as many points agree as at any pose beside it. The coarsest
one has to, because on a facade a pose that is off by a window agrees with details as well: on
castle-P19 such a pose has 39 points and 9 beside it at half the size, but 665 and 295 at an eighth.
"""
MIN_PATCHES = 20
"""At the coarsest octave, the points that agree must amount to so many patches without overlap. In
a model with many points, they may lie in a few corners: at a pose of fountain-P11 0010 that is 42
degrees off, 137 points agree and 13 beside it, in 13 patches. At right ones it is 12 to 70."""


def search(
    poses: Sequence[PoseHypothesis],
    structure: Model,
    images: DeviceImages,
    refinement: Refinement,
) -> None:
    """Search around poses that have been followed, in place, for what stands out.

    Args:
      poses: of views that are not among those of the structure, followed over all octaves.
      structure, images, refinement: as in `jaxsfm.sfm.refine.octave_pose.follow`.
    """
    moved = _climb(poses, structure, images, refinement)
    follow(moved, structure, images, refinement)
    _compare(poses, structure, images, refinement)


def _climb(
    poses: Sequence[PoseHypothesis],
    structure: Model,
    images: DeviceImages,
    refinement: Refinement,
) -> list[PoseHypothesis]:
    """Move poses to where the coarsest octave shows most; returns those that have moved, which are
    as if nothing had agreed with them yet."""
    coarsest = _coarsest(refinement)
    way_px = REACH * coarsest * (2 * refinement.radius + 1)
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    ways = way_px * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    climbing, moved = list(poses), dict[PoseHypothesis, None]()
    for pose in climbing:
        pose.view = pose.octaves[max(pose.octaves)].view if pose.octaves else pose.view
    for _ in range(MAX_CLIMB):
        if not climbing:
            break
        tried = [
            [
                PoseHypothesis(view=view, own_camera=pose.own_camera)
                for view in [pose.view, *(_turned(pose.view, way) for way in ways)]
            ]
            for pose in climbing
        ]
        settle([each for own in tried for each in own], structure, images, refinement, coarsest)
        higher = []
        for pose, own in zip(climbing, tried, strict=True):
            best = max(own, key=lambda each: each.agreed)
            if best.agreed > max(MORE * own[0].agreed, MIN_COUNT):
                pose.view = best.view
                higher.append(pose)
        moved |= dict.fromkeys(higher)
        climbing = higher
    for pose in moved:
        pose.octaves, pose.share = {}, 0.0
    return list(moved)


def _compare(
    poses: Sequence[PoseHypothesis],
    structure: Model,
    images: DeviceImages,
    refinement: Refinement,
) -> None:
    """Say of poses, in place, which of their octaves stands out."""
    every = [(pose, each) for pose in poses for each in pose.octaves.values()]
    ahead: dict[PoseHypothesis, list[OctavePose]] = {pose: [] for pose in poses}
    for px in sorted({each.octave_px for _, each in every}):
        way_px = BESIDE * px * (2 * refinement.radius + 1)
        ways = way_px * np.asarray([[1, 0], [-1, 0], [0, 1], [0, -1]])
        own = [(pose, each) for pose, each in every if each.octave_px == px]
        views = [_turned(each.view, way) for _, each in own for way in ways]
        shown = shown_from(views, structure, images, refinement, px)
        counts = np.reshape([len(seen.rows) for _, seen in shown], (len(own), len(ways)))
        for (pose, each), beside in zip(own, counts.max(1).tolist(), strict=True):
            if each.agreed >= STANDS_OUT * beside:
                ahead[pose].append(each)
    for pose, found in ahead.items():
        pose.searched = True
        ground = [each for each in found if each.octave_px == _coarsest(refinement)]
        if any(each.patches >= MIN_PATCHES for each in ground):
            pose.stands_out = min(found, key=lambda each: each.doubt_px)


def _coarsest(refinement: Refinement) -> int:
    """Working pixels per pixel of the coarsest octave."""
    return 2 ** (refinement.weak_octaves - 1)


def _turned(view: View, way: np.ndarray) -> View:
    """A view turned so that what its middle shows moves by (x, y) working pixels."""
    right, down = way * view.mean_scale / view.camera.mean_focal_length()
    turn = Rotation.from_rotvec([-down, right, 0.0]).as_matrix()
    return dataclasses.replace(view, rotation=turn @ view.rotation)
