"""New points of a model, triangulated from matches of views that have poses."""

from collections.abc import Collection, Mapping

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits
from jaxsfm.sfm.refine.track_alignment import align_blocks

TAKEN_PX = 4.0
"""A keypoint this near to an observation is on that point, working pixels: half a fine cell."""
MATCH_ERROR_PX = 4.0
"""Largest reprojection error of a matched keypoint, working pixels: COLMAP's limit for mapping."""
MIN_NEW_POINTS = 10
"""Fewer new points are not aligned, because they determine no planes."""


def _on_points(tracks: Tracks, view: int, xy: np.ndarray) -> np.ndarray:
    """bool (n,): which pixels (n, 2) of a view lie on a point that the view shows already."""
    own = tracks.view == view
    if not own.any() or not len(xy):
        return np.zeros(len(xy), bool)
    distance, _ = KDTree(tracks.xy[own]).query(xy)
    return np.asarray(distance) <= TAKEN_PX


def matched_tracks(
    model: Model, fresh: Collection[str], matches: Mapping[Pair, PairResult]
) -> Tracks:
    """Tracks of matched keypoints on which no point of the model lies yet.

    Keypoints are joined over all matches of fresh views with any view. A track that reaches two
    keypoints of one view is left out.

    Args:
      fresh: names of the views that are new in the model.
      matches: original pixels. Pairs of other images are ignored.

    Returns:
      tracks in the views of the model; their points are zero, as they are not known yet.
    """
    index = {view.name: k for k, view in enumerate(model.views)}
    ends: list[list[np.ndarray]] = [[], []]
    places: list[tuple[np.ndarray, np.ndarray]] = []
    for pair in sorted(matches):
        if not (pair[0] in index and pair[1] in index and set(pair) & set(fresh)):
            continue
        result = matches[pair]  # read from disk
        free, sides = np.ones(result.num_inliers, bool), []
        for side, xy in enumerate((result.keypoints0, result.keypoints1)):
            k = index[pair[side]]
            at = model.views[k].pixels.from_original(xy)
            free &= ~_on_points(model.tracks, k, at)
            sides.append((k * 2**32 + result.cells[:, side].astype(np.int64), at))
        for end, (node, at) in zip(ends, sides, strict=True):
            end.append(node[free])
            places.append((node[free], at[free]))
    if not places:
        return Tracks.empty()
    nodes, xy = (np.concatenate(column) for column in zip(*places, strict=True))
    nodes, first = np.unique(nodes, return_index=True)
    xy, view = xy[first], nodes // 2**32
    a, b = (np.searchsorted(nodes, np.concatenate(end)) for end in ends)
    links = coo_array((np.ones(len(a), bool), (a, b)), shape=(len(nodes), len(nodes)))
    count, label = connected_components(links, directed=False)
    _, views_in = np.unique(np.c_[label, view], axis=0, return_counts=True)
    twice = np.unique(np.c_[label, view], axis=0)[views_in > 1, 0]
    good = np.ones(count, bool)
    good[twice] = False
    keep = np.flatnonzero(good[label])
    kept, point = np.unique(label[keep], return_inverse=True)
    return Tracks(np.zeros((len(kept), 3)), point, view[keep], xy[keep])


def triangulated(model: Model) -> Model:
    """The model with every point at the least squares of distances to its observations' rays.

    The point is NaN where the rays are parallel or there are fewer than two. Where a camera's
    distortion cannot be undone, an observation has no ray, and does not count.
    """
    tracks = model.tracks
    normal = np.zeros((len(tracks.points), 3, 3))
    right = np.zeros((len(tracks.points), 3))
    for k, view in enumerate(model.views):
        own = tracks.view == k
        ray, point = view.rays(tracks.xy[own]), tracks.point[own]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        there = np.isfinite(ray).all(1)
        ray, point = ray[there], point[there]
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        np.add.at(normal, point, across)
        np.add.at(right, point, across @ view.centre)
    # Parallel rays leave the depth unknown: the least eigenvalue is the squared sine between them.
    solvable = np.linalg.eigvalsh(normal)[:, 0] > 1e-6
    points = np.full(tracks.points.shape, np.nan)
    points[solvable] = np.linalg.solve(normal[solvable], right[solvable, :, None])[..., 0]
    return model.with_tracks(tracks._replace(points=points))


def _agreeing(model: Model, max_error_px: float) -> Model:
    """The model triangulated, without observations that are off and without points that fewer than
    two observations are left of. This is done twice, because what was off had moved the points."""
    for _ in range(2):
        model = triangulated(model)
        tracks = model.tracks.select(model.errors_px() <= max_error_px)
        keep = (tracks.num_observations() >= 2) & np.isfinite(tracks.points).all(1)
        model = model.with_tracks(tracks.select_points(np.flatnonzero(keep)))
    return model


def new_points(
    model: Model,
    fresh: Collection[str],
    matches: Mapping[Pair, PairResult],
    images: DeviceImages,
    *,
    refinement: Refinement | None,
) -> Tracks:
    """Points on which fresh views and others agree, and which the model does not have.

    Args:
      fresh: names of the views that are new in the model.
      matches: original pixels.
      images: those of the views, in working pixels.
      refinement: that of the model: the observations are moved onto one patch each, as the model's
        were. None: they stay where they were matched.
    """
    found = _agreeing(model.with_tracks(matched_tracks(model, fresh, matches)), MATCH_ERROR_PX)
    if refinement is None or len(found.tracks.points) < MIN_NEW_POINTS:
        return found.tracks
    limits = AlignmentLimits.of(refinement)
    blocks = align_blocks(found, images, refinement, limits)
    parts = [part for block in blocks for part in block.observations()]
    aligned = found.with_tracks(Tracks.from_parts(found.tracks.points, parts))
    return _agreeing(aligned, refinement.max_error_px).tracks
