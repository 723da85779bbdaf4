"""Local planes at 3-D points: normals, reference views, which views could see a point, and how a
patch maps from one view to another. Pure functions of numpy arrays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxsfm.colmap.model import Tracks, View

MIN_NORMAL_COSINE = 0.05


class Visibility(NamedTuple):
    """Every point in every view."""

    cosine: np.ndarray
    """float (n, v): between the normal and the direction to the camera."""
    log_scale: np.ndarray
    """float (n, v): logarithm of image area per surface area, up to a constant."""
    tracked: np.ndarray
    """bool (n, v): the point's track has an observation there."""
    xy: np.ndarray
    """float (n, v, 2): that observation, else NaN."""


class Candidates(NamedTuple):
    """Observations to be aligned: point `point[k]` in `view[k]`."""

    point: np.ndarray
    view: np.ndarray
    start: np.ndarray
    """float (m, 2): where the model puts it, working pixels."""
    affine: np.ndarray
    """float (m, 2, 2): offsets in the reference view to offsets in the view."""


def normals(tracks: Tracks, views: list[View], *, neighbours: int) -> np.ndarray:
    """Unit normals (n, 3) from each point's nearest points, towards the cameras that see it.

    Distances are weighted down beyond the median one, so that a neighbour on another surface does
    not turn the plane.
    """
    points = tracks.points
    k = min(neighbours, len(points))
    distance, index = KDTree(points).query(points, k=k)
    local = points[index.reshape(len(points), k)]
    local = local - np.median(local, axis=1, keepdims=True)
    reach = np.median(distance.reshape(len(points), k), axis=1)[:, None] + 1e-12
    weight = 1 / (1 + (np.linalg.norm(local, axis=2) / reach) ** 2)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj,nk->nij", local, local, weight))
    normal = vectors[:, :, 0]
    towards = np.zeros_like(points)
    centres = np.asarray([view.centre for view in views])
    np.add.at(towards, tracks.point, centres[tracks.view] - points[tracks.point])
    return normal * np.where(np.einsum("ni,ni->n", towards, normal) < 0, -1.0, 1.0)[:, None]


def visibility(tracks: Tracks, views: list[View], normal: np.ndarray) -> Visibility:
    """How every view would see every point's plane."""
    n, v = len(tracks.points), len(views)
    cosine, log_scale = np.zeros((n, v)), np.zeros((n, v))
    for k, view in enumerate(views):
        ray = view.centre - tracks.points
        distance = np.linalg.norm(ray, axis=1)
        cosine[:, k] = np.einsum("ni,ni->n", ray, normal) / distance
        focal = view.camera.mean_focal_length() / view.scale.mean()
        log_scale[:, k] = np.log(np.maximum(cosine[:, k], MIN_NORMAL_COSINE)) + 2 * np.log(
            focal / distance
        )
    tracked = np.zeros((n, v), bool)
    tracked[tracks.point, tracks.view] = True
    xy = np.full((n, v, 2), np.nan)
    xy[tracks.point, tracks.view] = tracks.xy
    return Visibility(cosine, log_scale, tracked, xy)


def reference_views(seen: Visibility) -> np.ndarray:
    """For every point the tracked view of median scale: neither blown up nor shrunk elsewhere."""
    order = np.argsort(np.where(seen.tracked, seen.log_scale, np.inf), axis=1, kind="stable")
    middle = seen.tracked.sum(1) // 2
    return order[np.arange(len(order)), middle]


def on_reference_rays(
    tracks: Tracks, views: list[View], normal: np.ndarray, reference: np.ndarray, xy: np.ndarray
) -> np.ndarray:
    """The points (n, 3) moved onto the rays of their reference keypoints `xy`, along their planes.

    Where the plane is nearly parallel to the ray, the depth is kept instead.
    """
    moved = np.empty_like(tracks.points)
    for k, view in enumerate(views):
        rows = np.flatnonzero(reference == k)
        moved[rows] = _on_planes(view, xy[rows], tracks.points[rows], normal[rows])
    return moved


def _on_planes(view: View, xy: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Where the rays of pixels (n, 2) meet the planes through points (n, 3); at the points' depth
    where the plane is nearly parallel to the ray."""
    ray = view.rays(xy)
    offset = points - view.centre
    depth = offset @ view.rotation[2]
    along = np.einsum("ni,ni->n", ray, normal)
    steep = np.abs(along) < 0.1
    hit = np.einsum("ni,ni->n", offset, normal) / np.where(steep, 1.0, along)
    hit = np.where(steep | (np.abs(hit - depth) > 0.05 * depth), depth, hit)
    return view.centre + hit[:, None] * ray


def under_pixels(
    tracks: Tracks,
    views: list[View],
    normal: np.ndarray,
    view: int,
    xy: np.ndarray,
    *,
    reach_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The surface (m, 3) under those of the pixels (n, 2) of a view that have an observation near,
    and which they are: (m,) indices."""
    own = np.flatnonzero(tracks.view == view)
    if not len(own) or not len(xy):
        return np.zeros((0, 3)), np.zeros(0, np.int64)
    distance, nearest = map(np.asarray, KDTree(tracks.xy[own]).query(xy))
    near = np.flatnonzero(distance <= reach_px)
    point = tracks.point[own[nearest[near]]]
    return _on_planes(views[view], xy[near], tracks.points[point], normal[point]), near


def candidates(
    points: np.ndarray,
    views: list[View],
    normal: np.ndarray,
    reference: np.ndarray,
    xy: np.ndarray,
    seen: Visibility,
    *,
    margin: float,
    min_cosine: float,
    max_stretch: float,
    targets: Sequence[int] | None = None,
) -> Candidates:
    """The observations of every track, and the views that could see its point beside them.

    Args:
      targets: only these views.
      points: on the reference rays.
      reference, xy: the reference view of every point, and its keypoint there.
      margin: pixels to the border of the view.
    """
    every = np.arange(len(points))
    own_scale = seen.log_scale[every, reference]
    parts = []
    for k in range(len(views)) if targets is None else targets:
        view = views[k]
        at, _ = view.project(points)
        with np.errstate(invalid="ignore"):
            inside = (at >= margin).all(1) & (at <= np.asarray(view.size) - 1 - margin).all(1)
        fits = (seen.cosine[:, k] > min_cosine) & (
            np.abs(seen.log_scale[:, k] - own_scale) < np.log(max_stretch)
        )
        rows = np.flatnonzero(inside & (reference != k) & (seen.tracked[:, k] | fits))
        parts.append((rows, np.full(len(rows), k), at[rows]))
    point = np.concatenate([p for p, _, _ in parts])
    view = np.concatenate([v for _, v, _ in parts])
    start = np.concatenate([s for _, _, s in parts])
    affine = plane_affines(points[point], views, normal[point], reference[point], view, xy[point])
    ok = np.isfinite(affine).all((1, 2))
    return Candidates(point[ok], view[ok], start[ok], affine[ok])


def plane_affines(
    points: np.ndarray,
    views: list[View],
    normal: np.ndarray,
    reference: np.ndarray,
    view: np.ndarray,
    xy: np.ndarray,
    *,
    step: float = 2.0,
) -> np.ndarray:
    """Derivative (m, 2, 2) of pixels in `view` by pixels in `reference`, through the plane.

    Central differences over `step` pixels, so that any camera model serves.
    """

    def through(offset: tuple[float, float]) -> np.ndarray:
        target = np.empty_like(points)
        for k in np.unique(reference):
            rows = reference == k
            ray = views[k].rays(xy[rows] + offset)
            along = np.einsum("ni,ni->n", ray, normal[rows])
            along = np.where(np.abs(along) < 1e-9, np.nan, along)
            hit = np.einsum("ni,ni->n", points[rows] - views[k].centre, normal[rows]) / along
            target[rows] = views[k].centre + hit[:, None] * ray
        at = np.empty((len(points), 2))
        for k in np.unique(view):
            rows = view == k
            at[rows] = views[k].project(target[rows])[0]
        return at

    columns = [
        (through(plus) - through(minus)) / (2 * step)
        for plus, minus in (((step, 0.0), (-step, 0.0)), ((0.0, step), (0.0, -step)))
    ]
    return np.stack(columns, axis=2)
