"""Local planes at 3-D points: their normals, how views see them, and their patches in reference
views. Pure functions of numpy arrays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.view import View

MIN_NORMAL_COSINE = 0.05
"""Where a plane is seen from the side, its scale is taken for this cosine."""


class Visibility(NamedTuple):
    """How every view would see every point's plane."""

    cosine: np.ndarray
    """float (n, v): between the normal and the direction to the camera."""
    log_scale: np.ndarray
    """float (n, v): logarithm of image area per surface area, up to a constant."""
    tracked: np.ndarray
    """bool (n, v): the point's track has an observation in the view."""
    xy: np.ndarray
    """float (n, v, 2): that observation, working pixels; NaN where there is none."""


class ReferencePatches(NamedTuple):
    """Planar patches, each given by its keypoint in one reference view."""

    points: np.ndarray
    """float64 (n, 3): world points on the rays of the keypoints."""
    normal: np.ndarray
    """float64 (n, 3): unit normals."""
    reference: np.ndarray
    """int (n,): index of the reference view."""
    xy: np.ndarray
    """float64 (n, 2): the keypoint in the reference view, working pixels."""

    def select(self, rows: np.ndarray) -> "ReferencePatches":
        """Some of the patches, by index."""
        return ReferencePatches(*(column[rows] for column in self))


def normals(model: Model, *, neighbours: int) -> np.ndarray:
    """Unit normals (n, 3) from each point's nearest points, towards the cameras that see it.

    Neighbours count less the further they are beyond the median distance, so that a neighbour on
    another surface does not turn the plane.
    """
    tracks, points = model.tracks, model.tracks.points
    k = min(neighbours, len(points))
    distance, index = KDTree(points).query(points, k=k)
    local = points[index.reshape(len(points), k)]
    local = local - np.median(local, axis=1, keepdims=True)
    reach = np.median(distance.reshape(len(points), k), axis=1)[:, None] + 1e-12
    weight = 1 / (1 + (np.linalg.norm(local, axis=2) / reach) ** 2)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj,nk->nij", local, local, weight))
    normal = vectors[:, :, 0]
    towards = np.zeros_like(points)
    centres = np.asarray([view.centre for view in model.views])
    np.add.at(towards, tracks.point, centres[tracks.view] - points[tracks.point])
    return normal * np.where(np.einsum("ni,ni->n", towards, normal) < 0, -1.0, 1.0)[:, None]


def seen_by(
    views: Sequence[View], which: np.ndarray | int, points: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How planes at points (n, 3) with normals (n, 3) are seen, each by one view.

    Args:
      which: int (n,), the view of each point, or one for all.

    Returns:
      float64 (n,), their cosines and logarithms of scale, as in `Visibility`. Both are NaN where
      the camera stands in the point, and such a view fits nothing.
    """
    centres = np.stack([view.centre for view in views])
    focal = np.asarray([view.focal_px for view in views])
    ray = centres[which] - points
    distance = np.linalg.norm(ray, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.einsum("ni,ni->n", ray, normal) / distance
        facing = np.log(np.maximum(cosine, MIN_NORMAL_COSINE))
        return cosine, facing + 2 * np.log(focal[which] / distance)


def visibility(model: Model, normal: np.ndarray) -> Visibility:
    """How every view would see every point's plane, of normals (n, 3)."""
    tracks = model.tracks
    n, v = len(tracks.points), len(model.views)
    cosine, log_scale = np.zeros((n, v)), np.zeros((n, v))
    for k, view in enumerate(model.views):
        cosine[:, k], log_scale[:, k] = seen_by([view], 0, tracks.points, normal)
    tracked = np.zeros((n, v), bool)
    tracked[tracks.point, tracks.view] = True
    xy = np.full((n, v, 2), np.nan)
    xy[tracks.point, tracks.view] = tracks.xy
    return Visibility(cosine, log_scale, tracked, xy)


def reference_views(seen: Visibility) -> np.ndarray:
    """int (n,): for every point the tracked view of median scale.

    A patch of that view is enlarged little, and reduced little, in the other views.
    """
    order = np.argsort(np.where(seen.tracked, seen.log_scale, np.inf), axis=1, kind="stable")
    middle = seen.tracked.sum(1) // 2
    return order[np.arange(len(order)), middle]


def reference_patches(model: Model, normal: np.ndarray, seen: Visibility) -> ReferencePatches:
    """The points' patches in their reference views, moved onto the rays of their keypoints."""
    reference = reference_views(seen)
    xy = seen.xy[np.arange(len(reference)), reference]
    points = on_reference_rays(model, normal, reference, xy)
    return ReferencePatches(points, normal, reference, xy)


def on_reference_rays(
    model: Model, normal: np.ndarray, reference: np.ndarray, xy: np.ndarray
) -> np.ndarray:
    """The points (n, 3) moved along their planes onto the rays of their reference keypoints.

    Where the plane is nearly parallel to the ray, the depth is kept instead.

    Args:
      normal: (n, 3).
      reference: int (n,), indices of views.
      xy: (n, 2), the keypoints, working pixels.
    """
    points = model.tracks.points
    moved = np.empty_like(points)
    for k, view in enumerate(model.views):
        rows = np.flatnonzero(reference == k)
        moved[rows] = _on_planes(view, xy[rows], points[rows], normal[rows])
    return moved


def _on_planes(view: View, xy: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Where the rays of pixels (n, 2) meet the planes through points (n, 3).

    Where the plane is nearly parallel to the ray, the place at the point's depth.
    """
    ray = view.rays(xy)
    offset = points - view.centre
    depth = offset @ view.rotation[2]
    along = np.einsum("ni,ni->n", ray, normal)
    steep = np.abs(along) < 0.1
    hit = np.einsum("ni,ni->n", offset, normal) / np.where(steep, 1.0, along)
    hit = np.where(steep | (np.abs(hit - depth) > 0.05 * depth), depth, hit)
    return view.centre + hit[:, None] * ray


def under_pixels(
    model: Model, normal: np.ndarray, view: int, xy: np.ndarray, *, reach_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """The surface under pixels (n, 2) of a view.

    Args:
      normal: (points, 3), of the model's points.
      view: index of the view.
      reach_px: a pixel lies on the plane of the nearest observation if that is this near.

    Returns:
      float64 (m, 3) world points, for the pixels that have an observation near; int (m,), which
      pixels these are.
    """
    tracks = model.tracks
    own = model.rows[view]
    if not len(own) or not len(xy):
        return np.zeros((0, 3)), np.zeros(0, np.int64)
    distance, nearest = map(np.asarray, KDTree(tracks.xy[own]).query(xy))
    near = np.flatnonzero(distance <= reach_px)
    point = tracks.point[own[nearest[near]]]
    return _on_planes(model.views[view], xy[near], tracks.points[point], normal[point]), near
