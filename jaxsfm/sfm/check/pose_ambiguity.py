"""Second places of photos: whether a photo also fits where pairs say that the model ignores.

Pairs that do not agree with a model are usually false. Then the photo shows something else where
they would put it. If it shows the same, nothing tells the two places apart, and another model
explains the photos as well.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.resection import find_view
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.check.agreement import agreement
from jaxsfm.sfm.check.check_model import VerifiedMatches, thinned, thinned_points
from jaxsfm.sfm.check.grouping import MAX_CONTRADICTED
from jaxsfm.sfm.check.model_check import PoseAmbiguity
from jaxsfm.sfm.limits import POSE_AMBIGUITY
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.refine.candidates import may_show
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import MATCH_ERROR_PX, matched_points
from jaxsfm.sfm.view_graph import rotation_angle_deg


class Refused(NamedTuple):
    """What speaks for other places: the pairs that a model does not agree with."""

    pairs: Mapping[Pair, PairResult]
    """Their matches, original pixels."""
    seed: int
    """For RANSAC."""


class Surface(NamedTuple):
    """The points of a model as pieces of a surface."""

    model: Model
    normal: np.ndarray
    """float64 (points, 3)."""

    def few(self) -> "Surface":
        """So many of the points as are tested in a second place."""
        rows = thinned_points(self.model, per_view=POSE_AMBIGUITY.tested_per_view)
        tracks = self.model.tracks.select_points(rows)
        return Surface(self.model.with_tracks(tracks), self.normal[rows])

    def of_others(self, k: int) -> "Surface":
        """The same without the observations of one view, by index."""
        return self._replace(model=self.model.select(self.model.tracks.view != k))

    def with_view(self, k: int, view: View) -> "Surface":
        """The same with another view in the place of one, by index."""
        views = self.model.views
        return self._replace(model=self.model.with_views([*views[:k], view, *views[k + 1 :]]))


def pose_ambiguity(
    whole: Surface,
    few: Surface,
    images: DeviceImages,
    refinement: Refinement,
    refused: Refused,
    k: int,
) -> PoseAmbiguity | None:
    """The second place of a view; None if it has none.

    Args:
      whole: places are found from its points.
      few: those of its points that are tested (`Surface.few`).
      images: those of the views, in the model's pixels.
      k: index of the view.
    """
    view = whole.model.views[k]
    own = {pair: each for pair, each in refused.pairs.items() if view.name in pair}
    parts = [matched_points(view, *whole, {pair: each}) for pair, each in own.items()]
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
    tested, contradicted = shown_by(few.with_view(k, there), images, refinement, k)
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


def shown_by(few: Surface, images: DeviceImages, refinement: Refinement, k: int) -> tuple[int, int]:
    """What a view shows of the points that other views have seen.

    Args:
      few: the points that are tested, with the view where it is to stand.
      images: those of the views, in the model's pixels.
      k: index of the view.

    Returns:
      the number of points that it should show and on which something can be said, and the number of
      contradictions among them (`jaxsfm.sfm.check.agreement`): means over the other views.
    """
    # What the view itself has contributed to the model holds at its first place only.
    model, normal = few.of_others(k)
    rows = np.flatnonzero(may_show(model.tracks.points, [model.views[k]]))
    some = model.with_tracks(model.tracks.select_points(rows))
    found = agreement(some, images, refinement, targets=[k], normal=normal[rows])
    counts = found.tested[:, k]
    if not counts.any():
        return 0, 0
    weight = counts / counts.sum()
    return round(weight @ counts), round(weight @ found.contradicted[:, k])


def pose_ambiguities(
    surface: Surface, images: DeviceImages, refinement: Refinement, refused: Refused
) -> list[PoseAmbiguity]:
    """The second places of all views of a model, sorted by name. Arguments as in
    `pose_ambiguity`."""
    named, few = {name for pair in refused.pairs for name in pair}, surface.few()
    found = [
        pose_ambiguity(surface, few, images, refinement, refused, k)
        for k, view in enumerate(surface.model.views)
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
    model = thinned(model)
    normal = plane_geometry.normals(model, neighbours=refinement.neighbours)
    refused = Refused({pair: given.matches[pair] for pair in sorted(against)}, given.seed)
    return pose_ambiguities(Surface(model, normal), images, refinement, refused)
