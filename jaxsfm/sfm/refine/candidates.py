"""Candidates: the views in which a point may be observed, and how its patch maps into them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import present_groups
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.sfm.refine.plane_geometry import ReferencePatches, Visibility, seen_by

SLACK = 0.25
"""Share of a view's sides, beyond its borders. Points outside are left out early; they may still
move along their reference rays before they are aligned, by at most 5 % of their depth."""
STEP = 2.0
"""The differences that give the derivatives of a patch are taken over so many pixels."""


class Candidates(NamedTuple):
    """Possible observations, to be aligned: candidate k is of point `point[k]` in `view[k]`."""

    point: np.ndarray
    view: np.ndarray
    start: np.ndarray
    """float (m, 2): where the model puts it, working pixels."""
    affine: np.ndarray
    """float (m, 2, 2): offsets in the reference view to offsets in the view."""


def find_candidates(
    views: Sequence[View],
    patches: ReferencePatches,
    seen: Visibility,
    refinement: Refinement,
    *,
    targets: Sequence[int] | None = None,
) -> Candidates:
    """The observations of every track, and other views that could see its patch.

    Args:
      refinement: `min_cosine` and `max_stretch` limit the views that could see a patch, and
        `most_views` their number; `radius` gives the distance that a keypoint must have from the
        border.
      targets: only these views, by index; None: all.
    """
    margin = refinement.radius + 2
    own_scale = seen.log_scale[np.arange(len(patches.points)), patches.reference]
    parts = []
    for k in range(len(views)) if targets is None else targets:
        view = views[k]
        at, _ = view.project(patches.points)
        with np.errstate(invalid="ignore"):
            inside = (at >= margin).all(1) & (at <= np.asarray(view.size) - 1 - margin).all(1)
        fits = (seen.cosine[:, k] > refinement.min_cosine) & (
            np.abs(seen.log_scale[:, k] - own_scale) < np.log(refinement.max_stretch)
        )
        rows = np.flatnonzero(inside & (patches.reference != k) & (seen.tracked[:, k] | fits))
        parts.append((rows, np.full(len(rows), k), at[rows]))
    point, view, start = (np.concatenate(column) for column in zip(*parts, strict=True))
    if refinement.most_views:
        few = within_most_views(point, view, seen.tracked[point, view], refinement.most_views)
        point, view, start = point[few], view[few], start[few]
    affine = plane_affines(views, patches.select(point), view)
    ok = np.isfinite(affine).all((1, 2))
    return Candidates(point[ok], view[ok], start[ok], affine[ok])


def may_be_candidates(
    model: Model, normal: np.ndarray, refinement: Refinement, targets: Sequence[int]
) -> np.ndarray:
    """bool (n,): the points of which some views may become candidates, and a few more.

    A view that stands far from a street has all of it in its image, but could align none of it.

    Args:
      normal: float64 (n, 3), of the model's points, each of which has an observation.
      targets: indices of the views.
    """
    tracks, stretch = model.tracks, np.log(refinement.max_stretch)
    shown = may_show(tracks.points, [model.views[k] for k in targets])
    own = shown[tracks.point]
    point, view = tracks.point[own], tracks.view[own]
    least, most = np.full(len(shown), np.inf), np.full(len(shown), -np.inf)
    _, scale = seen_by(model.views, view, tracks.points[point], normal[point])
    np.fmin.at(least, point, scale)
    np.fmax.at(most, point, scale)
    found = np.zeros(len(shown), bool)
    found[point[np.isin(view, targets)]] = True
    rows = np.flatnonzero(shown)
    for k in targets:
        cosine, scale = seen_by(model.views, k, tracks.points[rows], normal[rows])
        fits = (scale > least[rows] - stretch) & (scale < most[rows] + stretch)
        found[rows] |= fits & (cosine > refinement.min_cosine)
    return found


def may_show(points: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """bool (n,): whether points (n, 3) could lie in any of the views when they are aligned."""
    shown = np.zeros(len(points), bool)
    for view in views:
        at, _ = view.project(points)
        reach = SLACK * np.asarray(view.size)
        with np.errstate(invalid="ignore"):
            shown |= ((at >= -reach) & (at <= view.size + reach)).all(1)
    return shown


def within_most_views(
    point: np.ndarray, view: np.ndarray, tracked: np.ndarray, most: int
) -> np.ndarray:
    """bool (m,): candidates that remain if a point has at most so many views.

    Observations of tracks remain. Of the other views of a point, those are taken that come first in
    an order that is drawn for each point, so that they lie on all sides of it.

    Args:
      point, view: int (m,), of each candidate.
      tracked: bool (m,), whether it is an observation of a track.
      most: views of a point, that of its patch included.
    """
    order = np.lexsort((_drawn(point, view), ~tracked, point))
    place = np.empty(len(point), int)
    place[order] = np.arange(len(point)) - np.searchsorted(point[order], point[order])
    return tracked | (place < most - 1)


def _drawn(point: np.ndarray, view: np.ndarray) -> np.ndarray:
    """uint64 (m,): numbers that look random and follow from a point and a view (splitmix64)."""
    mixed = point.astype(np.uint64) << np.uint64(32) | view.astype(np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return mixed


def plane_affines(views: Sequence[View], patches: ReferencePatches, view: np.ndarray) -> np.ndarray:
    """Derivatives (m, 2, 2) of pixels in `view` by pixels in the reference view, via the plane.

    They are central differences, which serve any camera model.

    Args:
      view: int (m,), for each patch the index of the other view.
    """
    points, normal, reference, xy = patches
    # To compare all rows with each view again took a seventh of a check of 500 frames of kitchen.
    of_reference, of_view = present_groups(reference), present_groups(view)

    def through(offset: tuple[float, float]) -> np.ndarray:
        target = np.empty_like(points)
        for k, rows in of_reference:
            ray = views[k].rays(xy[rows] + offset)
            along = np.einsum("ni,ni->n", ray, normal[rows])
            along = np.where(np.abs(along) < 1e-9, np.nan, along)
            hit = np.einsum("ni,ni->n", points[rows] - views[k].centre, normal[rows]) / along
            target[rows] = views[k].centre + hit[:, None] * ray
        at = np.empty((len(points), 2))
        for k, rows in of_view:
            at[rows] = views[k].project(target[rows])[0]
        return at

    columns = [
        (through(plus) - through(minus)) / (2 * STEP)
        for plus, minus in (((STEP, 0.0), (-STEP, 0.0)), ((0.0, STEP), (0.0, -STEP)))
    ]
    return np.stack(columns, axis=2)
