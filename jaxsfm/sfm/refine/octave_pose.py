"""Poses of noisy views, found from octave to octave.

A view of noise, such as a photo by night, is aligned with the structure that other views make. This
is done at an eighth, a quarter and half of the working size, where noise averages out: a patch of
15 x 15 pixels of the third octave holds sixteen times the photons, and finds its place from sixteen
times as far. The coarsest octave comes first, and every octave starts from the pose of the one
before. Among the poses of all octaves, the one that its observations determine best is taken.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.resection import adjust_view
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.photos import Pixels
from jaxsfm.sfm.refine.fixed_structure import AlignedPoints, FixedStructure
from jaxsfm.sfm.refine.pose_uncertainty import distinct_patches, projected_uncertainty

MIN_COUNT = 30
"""An octave's pose counts only if at least so many points agree."""
MIN_SHARE = 0.05
"""At one octave at least, this share of the points that a view could show must agree, or the pose
is searched around (`jaxsfm.sfm.refine.pose_search`). At wrong poses up to 7 % agree, at right ones
8 to 70 % at an eighth of the size (docs/decisions/weak-views.md)."""
MAX_UNCERTAINTY_PX = 1.0
"""Largest uncertainty of a trusted pose, working pixels. Right poses have 0.2 to 0.7. Of 24 poses
followed from wrong starts (castle-P19 0016) one ends at 0.95, with 1.5 % of the points agreeing,
and the others end above 1.6 or without any point."""
MAX_SEARCHED_UNCERTAINTY_PX = 2.0
"""Largest uncertainty of a pose that stands out after a search, working pixels. Of right ones,
which are 0.5 to 3.3 px off (nights of fountain-P11 and castle-P19), it is 0.4 to 1.9; wrong ones
that are 16, 40 and 78 px off have 1.9, 2.5 and 4.2."""
MAX_DESCENTS, SURE_PX = 2, 0.5
"""A pose that ends more uncertain than SURE_PX (working pixels) is followed over all octaves once
more, from where it was best. A pose that was right only at the last octave finds more points at the
first (castle-P19 night 0008: 1.84 m off at the start, 0.43 after one descent, 0.07 after two)."""
MAX_STEPS, STILL_PX = 4, 0.5
"""The steps of an octave end when the median point moves by less, pixels of the octave. From 6.5 m
off, 8 % of what a view could show agreed at the first step, 15 % at the second."""


class OctavePose(NamedTuple):
    """The pose that one octave gives a view."""

    view: View
    octave_px: int
    """Working pixels per pixel of the octave."""
    points: AlignedPoints
    """The points within the error limit, in working pixels."""
    agreed: int
    error_px: float
    """Median distance of where points agree from where the pose puts them, working pixels."""
    uncertainty_px: float
    """How far off the view's projections are expected to be, working pixels
    (`jaxsfm.sfm.refine.pose_uncertainty.projected_uncertainty`)."""
    patches: int
    """How many patches without overlap the points that agreed amount to."""


@dataclasses.dataclass(kw_only=True, eq=False)
class PoseHypothesis:
    """A possible pose of a view, which is followed from octave to octave."""

    view: View
    """Where the last octave put it, in working pixels."""
    own_camera: bool
    """No other view has its camera, and its focal length may change."""
    octaves: dict[int, OctavePose] = dataclasses.field(default_factory=dict)
    """By working pixels per pixel of the octave: of the poses that the octave gave, the one of
    least uncertainty."""
    searched: bool = False
    """It was searched around, and has to stand out (`jaxsfm.sfm.refine.pose_search`)."""
    stands_out: OctavePose | None = None
    """After a search: the surest pose of those that show far more than poses beside them."""
    candidates: int = 0
    """Points that the view could show, at the last octave."""
    agreed: int = 0
    """Candidates that agreed, at the last octave."""
    share: float = 0.0
    """Largest share of the candidates that agreed at an octave."""

    @property
    def best(self) -> OctavePose | None:
        """The pose of least uncertainty among those of the octaves."""
        return min(self.octaves.values(), key=lambda each: each.uncertainty_px, default=None)


def trusted(pose: PoseHypothesis) -> OctavePose | None:
    """The pose of the best octave, or after a search the one that stands out; None if the evidence
    for it is not enough."""
    if pose.searched:
        found = pose.stands_out
        return found if found and found.uncertainty_px <= MAX_SEARCHED_UNCERTAINTY_PX else None
    best = pose.best
    enough = (
        best is not None and pose.share >= MIN_SHARE and best.uncertainty_px <= MAX_UNCERTAINTY_PX
    )
    return best if enough else None


def _step(
    pose: PoseHypothesis, view: View, seen: AlignedPoints, px: int, refinement: Refinement
) -> bool:
    """Move a pose to where the points of an octave put it.

    Args:
      view: that of the pose, in pixels of the octave.
      px: working pixels per pixel of the octave.

    Returns:
      whether it moved so far that another step is worth while.
    """
    pose.candidates, pose.agreed = len(seen.candidates), len(seen.rows)
    if pose.agreed < MIN_COUNT:
        return False
    moved = adjust_view(view, seen.xy, seen.points, refine_focal_length=pose.own_camera)
    if moved is None:
        return False
    pose.share = max(pose.share, pose.agreed / len(seen.candidates))
    pose.view = dataclasses.replace(moved, pixels=pose.view.pixels, size=pose.view.size)
    errors = np.linalg.norm(moved.project(seen.points)[0] - seen.xy, axis=1)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    error_px = float(np.median(errors))
    side = refinement.patch_side
    uncertainty_px = px * projected_uncertainty(
        moved,
        seen.points,
        seen.xy,
        seen.candidates,
        error_px,
        side,
        focal=pose.own_camera,
    )
    before = pose.octaves.get(px)
    if before is None or uncertainty_px < before.uncertainty_px:
        near = errors <= refinement.max_error_px
        xy = Pixels.octave(px).to_original(seen.xy[near])
        points = AlignedPoints(seen.rows[near], seen.points[near], xy, seen.candidates)
        pose.octaves[px] = OctavePose(
            view=pose.view,
            octave_px=px,
            points=points,
            agreed=pose.agreed,
            error_px=error_px * px,
            uncertainty_px=uncertainty_px,
            patches=distinct_patches(seen.xy, side),
        )
    way = moved.project(seen.points)[0] - view.project(seen.points)[0]
    return bool(np.median(np.linalg.norm(way, axis=1)) > STILL_PX)


def follow(poses: Sequence[PoseHypothesis], structure: FixedStructure) -> None:
    """Follow poses over all octaves, in place. Those that end uncertain are followed once more.

    Args:
      poses: of views that are not among those of the structure.
    """
    unsure = poses
    for _ in range(MAX_DESCENTS):
        if not unsure:
            break
        for pose in unsure:
            pose.view = pose.best.view if pose.best else pose.view
        _descend(unsure, structure)
        unsure = [pose for pose in unsure if pose.best and pose.best.uncertainty_px > SURE_PX]


def _descend(poses: Sequence[PoseHypothesis], structure: FixedStructure) -> None:
    """From the coarsest octave to the finest, in place."""
    for octave in reversed(range(structure.refinement.weak_octaves)):
        converge(poses, structure, 2**octave)


def converge(poses: Sequence[PoseHypothesis], structure: FixedStructure, px: int) -> None:
    """Move poses at one octave until they stand still, in place.

    Args:
      px: working pixels per pixel of the octave.
    """
    moving = list(poses)
    for _ in range(MAX_STEPS):
        if not moving:
            break
        seen = structure.shown_from([pose.view for pose in moving], px)
        moving = [
            pose
            for pose, (view, each) in zip(moving, seen, strict=True)
            if _step(pose, view, each, px, structure.refinement)
        ]
