"""The place of one photo in finished models, which stay as they are: in the model of which it shows
most.

The photo's matches give a first pose by resection, and alignment follows it over the octaves
(`jaxsfm.sfm.refine.octave_pose`), as it does for weak views. Only some views of the model take
part, with the points that they see: so the work does not grow with the model.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.resection import MIN_RESECTION_POINTS, find_view
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import (
    MATCH_ERROR_PX,
    AlignedPoints,
    FixedStructure,
    ResectionMatches,
    matched_points,
)
from jaxsfm.sfm.refine.octave_pose import (
    MAX_SEARCHED_UNCERTAINTY_PX,
    MAX_UNCERTAINTY_PX,
    MIN_COUNT,
    MIN_SHARE,
    PoseHypothesis,
    follow,
    trusted,
)
from jaxsfm.sfm.refine.pose_search import MIN_PATCHES, STANDS_OUT, search
from jaxsfm.sfm.refine.pose_uncertainty import pose_uncertainty

LEAVES = 2.0
"""A match counts as left if it is off by more than this many times the error of an inlier."""
CELL_PX = 8
"""Side of a fine cell, working pixels. Matches that share a cell are not independent."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Localization:
    """The outcome for a photo."""

    view: View | None = None
    """The photo with its pose. None: neither alignment confirms a pose nor do 30 matches agree."""
    trusted: bool = False
    """Alignment confirms the pose. Otherwise it rests on matches alone."""
    why: str | None
    """Why it has no pose, or none that is trusted."""
    on_surface: int
    """Matches with the surface of the model under them."""
    inliers: int = 0
    """Matches on the surface that agree with the resection."""
    candidates: int = 0
    """Points of the model that it could show."""
    agreed: int = 0
    """Candidates that alignment finds there."""
    octave_px: int | None = None
    """Working pixels per pixel of the octave that gives the pose; None: it is not trusted."""
    error_px: float | None = None
    """Median distance of what determines the pose from where the pose puts it, working pixels."""
    uncertainty_px: float | None = None
    """How far off projections are expected to be, working pixels (`OctavePose.uncertainty_px`)."""
    centre_error: float | None = None
    """Expected error of the centre, units of the model. The model's own error comes on top."""
    rotation_error_deg: float | None = None
    """Expected error of the rotation. The model's own error comes on top."""
    points: AlignedPoints | None = None
    """The points that it shows, if the pose is trusted; working pixels."""

    @property
    def support(self) -> tuple[bool, int, int]:
        """What speaks for this outcome; of the outcomes in several models, the one with the largest
        support is taken.

        Where walls repeat, a photo of one model often resembles a part of another one. It shows
        more points of the model that it belongs to (docs/decisions/finished-models.md).
        """
        return self.trusted, self.agreed if self.trusted else self.inliers, self.on_surface

    @property
    def rests_on_details(self) -> bool:
        """Whether the place rests on details at full size, which the photo shows where it agrees.

        Full size may determine a pose best although noise hides most there: in a night photo of
        entry-P10, 106 of 18 012 points agree, and the pose is right.
        """
        return self.octave_px == 1 and self.agreed >= MIN_SHARE * self.candidates

    def refused(self, why: str) -> "Localization":
        """The same outcome, whose pose is not trusted."""
        return dataclasses.replace(self, trusted=False, octave_px=None, points=None, why=why)


def locate(
    image: View,
    structure: FixedStructure,
    resection: ResectionMatches,
    *,
    own_camera: bool,
) -> Localization:
    """Find the pose of a photo among views of a model.

    Args:
      image: size, pixels and camera of the photo; its pose plays no part.
      structure: the views, and the points that they see, which may be none.
      resection: matches of the photo with the views.
      own_camera: estimate the focal length too. It is estimated from nothing, unless the camera's
        was known before (`has_prior_focal_length`).
    """
    matches = resection.matches
    if not len(structure.model.tracks.points):
        return nowhere(0, matches)
    xy, points = matched_points(image, structure.model, structure.normals, matches)
    found = find_view(
        image,
        xy,
        points,
        max_error_px=MATCH_ERROR_PX,
        estimate_focal_length=own_camera and not image.camera.has_prior_focal_length,
        seed=resection.seed,
    )
    if found is None:
        return nowhere(len(xy), matches)
    errors = np.linalg.norm(found.project(points)[0] - xy, axis=1)
    near = np.isfinite(errors) & (errors <= MATCH_ERROR_PX)
    if near.sum() < MIN_RESECTION_POINTS:  # the camera has been refined since RANSAC counted
        return nowhere(len(xy), matches)
    pose = PoseHypothesis(view=found, own_camera=own_camera)
    if structure.refinement.weak_octaves:
        follow([pose], structure)
        if trusted(pose) is None:
            search([pose], structure)
    best = trusted(pose)
    if best is not None and pose.searched and _leaves(best.view, xy, points, near):
        best = None
    if best is None and near.sum() < MIN_COUNT:
        return Localization(
            why=_doubtful(pose, int(near.sum()), len(xy)),
            on_surface=len(xy),
            inliers=int(near.sum()),
            candidates=pose.candidates,
            agreed=pose.agreed,
        )
    if best is None:
        error_px = float(np.median(errors[near]))
        seen, side, view = (points[near], xy[near]), CELL_PX, found
    else:
        error_px, view = best.error_px, best.view
        seen = best.points.points, best.points.xy
        side = best.octave_px * structure.refinement.patch_side
    uncertainty = pose_uncertainty(view, *seen, error_px, side, focal=own_camera)
    return Localization(
        view=view,
        trusted=best is not None,
        why=None if best else _doubtful(pose, int(near.sum()), len(xy)),
        on_surface=len(xy),
        inliers=int(near.sum()),
        candidates=len(best.points.candidates) if best else pose.candidates,
        agreed=best.agreed if best else pose.agreed,
        octave_px=best.octave_px if best else None,
        error_px=error_px,
        uncertainty_px=best.uncertainty_px if best else None,
        centre_error=uncertainty.centre,
        rotation_error_deg=uncertainty.rotation_deg,
        points=best.points if best else None,
    )


def _leaves(view: View, xy: np.ndarray, points: np.ndarray, near: np.ndarray) -> bool:
    """Whether a search has left most of the matches that gave the pose, if these are many.

    A few matches of a night are often wrong. Many that agree with one pose are not, and then a
    search has found a repetition.
    """
    errors = np.linalg.norm(view.project(points)[0] - xy, axis=1)
    kept = near & np.isfinite(errors) & (errors <= LEAVES * MATCH_ERROR_PX)
    return bool(near.sum() >= MIN_COUNT and kept.sum() < near.sum() / 2)


def nowhere(on_surface: int, matches: Mapping[Pair, PairResult]) -> Localization:
    """The outcome where there is no pose, and why."""
    most = max((result.num_inliers for result in matches.values()), default=0)
    if most == 0:
        tentative = max((result.num_tentative for result in matches.values()), default=0)
        why = f"no plane in common with a photo of the model (at most {tentative} matches of cells)"
    elif on_surface < MIN_RESECTION_POINTS:
        why = (
            f"{on_surface} matches lie on the surface of the model, a pose needs "
            f"{MIN_RESECTION_POINTS} ({most} matches with its best photo)"
        )
    else:
        why = f"no pose agrees with enough of the {on_surface} matches on the model's surface"
    return Localization(why=why, on_surface=on_surface)


def _doubtful(pose: PoseHypothesis, inliers: int, on_surface: int) -> str:
    """Why a pose that matches give is not trusted."""
    start = f"a pose agrees with {inliers} of {on_surface} matches, but "
    if pose.best is None:
        return (
            f"{start}alignment finds {pose.agreed} of the {pose.candidates} points that it would "
            f"show there (needed: {MIN_COUNT})"
        )
    if trusted(pose) is not None:
        return f"{start}alignment finds another pose, which most of these matches contradict"
    if pose.searched and pose.stands_out is None:
        return (
            f"{start}what alignment finds there does not stand out (needed: {STANDS_OUT:g} times "
            f"as many points as beside it, in {MIN_PATCHES} patches)"
        )
    if not pose.searched and pose.share < MIN_SHARE:
        return (
            f"{start}alignment finds at most {100 * pose.share:.1f} % of the points that it would "
            f"show there (needed: {100 * MIN_SHARE:.0f} %)"
        )
    judged = pose.stands_out or pose.best
    most = MAX_SEARCHED_UNCERTAINTY_PX if pose.searched else MAX_UNCERTAINTY_PX
    return (
        f"{start}what alignment finds leaves {judged.uncertainty_px:.2f} px of uncertainty "
        f"(at most {most:g})"
    )


class UnregisteredView(NamedTuple):
    """A view that is in no model."""

    views: Sequence[View]
    """The view with the camera that it starts with in each model. Their poses play no part."""
    own_camera: bool
    """Its focal length is estimated."""
    shortlist: Sequence[str]
    """Names of the views that it is matched with."""


class LocatedView(NamedTuple):
    """The outcome of an attempt to find a view's place in a model."""

    model: int
    """Index of the model."""
    found: Localization
    rows: np.ndarray
    """int: for each point of the part of the model in which the view was looked for, the index of
    that point in the model."""


def locate_in(
    models: Sequence[Model],
    k: int,
    wanted: UnregisteredView,
    resection: ResectionMatches,
    images: DeviceImages,
    *,
    refinement: Refinement,
) -> LocatedView | None:
    """Look for a view in one of the models, from its matches with the views of its shortlist.

    Args:
      k: index of the model.
      images: those of the view and of its shortlist, in working pixels.

    Returns:
      None if no view of its shortlist is in the model.
    """
    names, view = {each.name for each in models[k].views}, wanted.views[k]
    around = [name for name in wanted.shortlist if name in names]
    if not around:
        return None
    part, rows = models[k].part(around)
    pairs, matches = [make_pair(view.name, name) for name in around], resection.matches
    found = locate(
        view,
        FixedStructure(part, images, refinement),
        resection._replace(matches={pair: matches[pair] for pair in pairs if pair in matches}),
        own_camera=wanted.own_camera,
    )
    return LocatedView(k, found, rows)


def best_location(places: Iterable[LocatedView | None]) -> LocatedView:
    """The place with most support; of equals, the one in the first model.

    Without any place, it is nowhere, and its model is the first one.
    """
    tried = [place for place in places if place is not None]
    if not tried:
        return LocatedView(0, nowhere(0, {}), np.zeros(0, int))
    return max(tried, key=lambda place: (place.found.support, -place.model))
