"""Weak views: their poses on the structure of other views.

A view is weak where refinement finds little to align, because noise hides it: a night among days.
Such views are registered on the structure that the others make, at octaves where noise averages out
(`jaxsfm.sfm.refine.octave_pose`). Points that agree there confirm a pose by themselves, so a dozen
right matches among many wrong ones are enough to start from.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.resection import find_view
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import (
    MATCH_ERROR_PX,
    FixedStructure,
    ResectionMatches,
    matched_points,
)
from jaxsfm.sfm.refine.octave_pose import (
    OctavePose,
    PoseHypothesis,
    follow,
    trusted,
)
from jaxsfm.sfm.refine.pose_search import search


@dataclasses.dataclass(frozen=True, kw_only=True)
class RegistrationAttempt:
    """The outcome for a weak view, or for an image that was not in the model."""

    name: str
    registered: bool
    """It was in the model before."""
    octave_px: int | None
    """Working pixels per pixel of the octave that gives the pose. None: too little agrees, and
    nothing changes."""
    candidates: int
    """Points of the other views that it could show."""
    agreed: int
    """Candidates that agree, at that octave (at the last one, if no octave gives the pose)."""
    error_px: float | None
    """Median distance of where they agree from where the pose puts them, working pixels."""
    held: int | None = None
    """A number: it was in the model before, had so many observations, and was taken out because
    they do not hold it there (`jaxsfm.sfm.refined_models.covisibility_components`). None: it was
    not."""
    reason: str = ""
    """Why an image without a place was not registered (`jaxsfm.sfm.register.lost`), in words. Empty
    if it was."""


def taken_out(name: str, held: int) -> RegistrationAttempt:
    """What became of a view that was taken out because its points do not hold it in the model.

    Args:
      held: the number of its observations.
    """
    return RegistrationAttempt(
        name=name, registered=True, octave_px=None, candidates=0, agreed=0, error_px=None, held=held
    )


def _structure(model: Model, weak: Sequence[int]) -> tuple[Model, np.ndarray]:
    """The points that at least two of the other views see, and which points they are."""
    strong = model.tracks.select(~np.isin(model.tracks.view, weak))
    rows = np.flatnonzero(strong.num_observations() >= 2)
    return model.with_tracks(strong.select_points(rows)), rows


def register_weak_views(
    model: Model,
    weak: Sequence[str],
    images: DeviceImages,
    *,
    refinement: Refinement,
    refine_intrinsics: bool,
    resection: ResectionMatches,
) -> tuple[Model, list[RegistrationAttempt]]:
    """Place weak views on the structure of the other views, which stays fixed.

    A registered view gets the observations that agree with its new pose instead of those it had. It
    starts from its pose and from its matches.

    Args:
      weak: names of views.
      images: those of the views, in working pixels.
      refine_intrinsics: whether the focal length of a registered view moves too, if no other view
        has its camera.

    Returns:
      the same model if no view could be registered; what became of each view.
    """
    weak_ones = [k for k, view in enumerate(model.views) if view.name in weak]
    strong, rows = _structure(model, weak_ones)
    poses: dict[int, list[PoseHypothesis]] = {k: [] for k in weak_ones}
    if len(rows) and refinement.weak_octaves:
        structure = FixedStructure(strong, images, refinement)
        poses = _starts(model.views, structure, weak_ones, resection, refine_intrinsics)
        follow([pose for mine in poses.values() for pose in mine], structure)
        lost = [mine for mine in poses.values() if not any(map(trusted, mine))]
        search([pose for mine in lost for pose in mine], structure)
    attempts, best = [], {}
    for k, mine in poses.items():
        right = [pose for pose in map(trusted, mine) if pose is not None]
        if right:
            best[k] = min(right, key=lambda pose: pose.uncertainty_px)
        attempts.append(_attempt(model.views[k].name, mine, best.get(k)))
    return (_with_registered(model, best, rows) if best else model), attempts


def _starts(
    images: Sequence[View],
    structure: FixedStructure,
    wanted: Sequence[int],
    resection: ResectionMatches,
    refine_intrinsics: bool,
) -> dict[int, list[PoseHypothesis]]:
    """The poses to follow, for each wanted view (an index).

    Args:
      images: the views of the structure.
    """
    model, normal = structure.model, structure.normals
    cameras = [view.camera.camera_id for view in images]
    starts = {}
    for k in wanted:
        own = refine_intrinsics and cameras.count(cameras[k]) == 1
        found = find_view(
            images[k],
            *matched_points(images[k], model, normal, resection.matches),
            max_error_px=MATCH_ERROR_PX,
            estimate_focal_length=own and not images[k].camera.has_prior_focal_length,
            seed=resection.seed,
        )
        starts[k] = [
            PoseHypothesis(view=view, own_camera=own)
            for view in [images[k], *([found] if found else [])]
        ]
    return starts


def _attempt(name: str, mine: list[PoseHypothesis], best: OctavePose | None) -> RegistrationAttempt:
    most = max(mine, key=lambda pose: pose.agreed, default=None)
    return RegistrationAttempt(
        name=name,
        registered=True,
        octave_px=best.octave_px if best else None,
        candidates=len(best.points.candidates) if best else most.candidates if most else 0,
        agreed=best.agreed if best else most.agreed if most else 0,
        error_px=best.error_px if best else None,
    )


def _with_registered(model: Model, best: Mapping[int, OctavePose], rows: np.ndarray) -> Model:
    """The model with registered views, whose old observations go.

    Args:
      best: by index of the view.
      rows: for each point of the structure its index in the model.
    """
    tracks, views = model.tracks, list(model.views)
    parts = [tracks.select(~np.isin(tracks.view, list(best))).observations]
    for k, pose in sorted(best.items()):
        views[k] = pose.view
        parts.append(pose.points.observations(k, rows))
    joined = Tracks.from_parts(tracks.points, parts, ordered=True)
    return model.with_views(views).with_tracks(joined)
