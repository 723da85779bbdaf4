"""Second places of photos: whether a photo also fits where pairs say that the model ignores.

Pairs that do not agree with a model are usually false. Then the photo shows something else where
they would put it. If it shows the same, nothing tells the two places apart, and another model
explains the photos as well.
"""

import dataclasses
from collections.abc import Collection

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.resection import find_view
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.agreement import agreement
from jaxsfm.sfm.check.check_model import VerifiedMatches, thinned, thinned_points
from jaxsfm.sfm.check.grouping import MAX_CONTRADICTED
from jaxsfm.sfm.check.model_check import PoseAmbiguity
from jaxsfm.sfm.limits import POSE_AMBIGUITY
from jaxsfm.sfm.refine.candidates import may_show
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import (
    MATCH_ERROR_PX,
    FixedStructure,
    ResectionMatches,
    matched_points,
)
from jaxsfm.sfm.view_graph import rotation_angle_deg


def few_points(whole: FixedStructure) -> FixedStructure:
    """So many of the points as are tested in a second place."""
    return whole.some(thinned_points(whole.model, per_view=POSE_AMBIGUITY.tested_per_view))


def pose_ambiguity(
    whole: FixedStructure, few: FixedStructure, refused: ResectionMatches, k: int
) -> PoseAmbiguity | None:
    """The second place of a view; None if it has none.

    Args:
      whole: the model; places are found from its points.
      few: those of its points that are tested (`few_points`).
      refused: what speaks for other places: the pairs that the model does not agree with.
      k: index of the view.
    """
    view = whole.model.views[k]
    own = {pair: each for pair, each in refused.matches.items() if view.name in pair}
    parts = [
        matched_points(view, whole.model, whole.normals, {pair: each}) for pair, each in own.items()
    ]
    xy, points = (np.concatenate(column) for column in zip(*parts, strict=True))
    there = find_view(
        view,
        xy,
        points,
        max_error_px=MATCH_ERROR_PX,
        estimate_focal_length=False,
        seed=refused.seed,
        min_inlier_share=POSE_AMBIGUITY.inlier_share,
    )
    if there is None or not _elsewhere(view, there, points):
        return None
    support = [_support(there, *part) for part in parts]
    if sum(support) < POSE_AMBIGUITY.least_inliers:
        return None
    partners = [
        a if b == view.name else b
        for (a, b), count in zip(own, support, strict=True)
        if count >= POSE_AMBIGUITY.least_support
    ]
    views = few.model.views
    moved = few.model.with_views([*views[:k], there, *views[k + 1 :]])
    tested, contradicted = shown_by(
        dataclasses.replace(few, model=moved, known_normals=few.normals), k
    )
    if (
        tested - contradicted < POSE_AMBIGUITY.least_agreed
        or contradicted > MAX_CONTRADICTED * tested
    ):
        return None
    return PoseAmbiguity(
        image=view.name,
        pairs=sorted(partners),
        agreed=tested - contradicted,
        contradicted=contradicted,
        rotation_deg=float(rotation_angle_deg(there.rotation, view.rotation)),
    )


def _support(there: View, xy: np.ndarray, points: np.ndarray) -> int:
    """How many keypoints (n, 2) agree with a place, from which points (n, 3) are seen."""
    at, _ = there.project(points)
    return int((np.linalg.norm(at - xy, axis=1) < MATCH_ERROR_PX).sum())


def _elsewhere(view: View, there: View, points: np.ndarray) -> bool:
    """Whether a place is another one than that of the view; from both, points (n, 3) are seen."""
    away = np.linalg.norm(there.centre - view.centre)
    distance = np.median(np.linalg.norm(points - there.centre, axis=1))
    turned = rotation_angle_deg(there.rotation, view.rotation)
    return bool(
        turned > POSE_AMBIGUITY.rotation_deg or away > POSE_AMBIGUITY.distance_share * distance
    )


def shown_by(few: FixedStructure, k: int) -> tuple[int, int]:
    """What a view shows of the points that other views have seen.

    Args:
      few: the points that are tested, with the view where it is to stand.
      k: index of the view.

    Returns:
      the number of points that it should show and on which something can be said, and the number of
      contradictions among them (`jaxsfm.sfm.check.agreement`): means over the other views.
    """
    # What the view itself has contributed to the model holds at its first place only.
    model = few.model.select(few.model.tracks.view != k)
    rows = np.flatnonzero(may_show(model.tracks.points, [model.views[k]]))
    some = model.with_tracks(model.tracks.select_points(rows))
    found = agreement(some, few.images, few.refinement, targets=[k], normal=few.normals[rows])
    counts = found.tested[:, k]
    if not counts.any():
        return 0, 0
    weight = counts / counts.sum()
    return round(weight @ counts), round(weight @ found.contradicted[:, k])


def pose_ambiguities(whole: FixedStructure, refused: ResectionMatches) -> list[PoseAmbiguity]:
    """The second places of all views of a model, sorted by name. Arguments as in
    `pose_ambiguity`."""
    named, few = {name for pair in refused.matches for name in pair}, few_points(whole)
    found = [
        pose_ambiguity(whole, few, refused, k)
        for k, view in enumerate(whole.model.views)
        if view.name in named
    ]
    places = [place for place in found if place is not None]
    return sorted(places, key=lambda place: place.image)


def find_pose_ambiguities(
    model: Model,
    images: DeviceImages,
    given: VerifiedMatches,
    refinement: Refinement,
    against: Collection[Pair],
) -> list[PoseAmbiguity]:
    """The second places of the photos of a model that has been checked.

    Args:
      images, given, refinement: as in `check_model`.
      against: the pairs that do not agree with the model.

    Raises:
      ImageError: an image of the model cannot be read any more.
    """
    matches = {pair: given.matches[pair] for pair in sorted(against)}
    whole = FixedStructure(thinned(model), images, refinement)
    return pose_ambiguities(whole, ResectionMatches(matches, given.seed))
