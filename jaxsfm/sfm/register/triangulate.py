"""New points from matches of views that have their poses, where a model has none yet."""

from collections.abc import Collection, Mapping

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jaxsfm.colmap.model import Tracks, View, errors_px, select
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Reader
from jaxsfm.sfm.refine.track_alignment import align_blocks

TAKEN_PX = 4.0
"""A keypoint this near to an observation is on that point, working pixels: half a fine cell."""
MATCH_ERROR_PX = 4.0
"""Reprojection error of a matched keypoint, working pixels: COLMAP's limit of the mapper."""
MIN_POINTS = 10
"""Fewer new points have no planes to be aligned by."""


def _taken(view: int, tracks: Tracks, xy: np.ndarray) -> np.ndarray:
    """Which pixels (n, 2) of a view lie on a point that it shows."""
    own = tracks.view == view
    if not own.any() or not len(xy):
        return np.zeros(len(xy), bool)
    distance, _ = KDTree(tracks.xy[own]).query(xy)
    return np.asarray(distance) <= TAKEN_PX


def matched_tracks(
    views: list[View],
    tracks: Tracks,
    fresh: Collection[str],
    matches: Mapping[Pair, PairResult],
) -> Tracks:
    """Tracks of keypoints that no point lies on, joined over all matches of the fresh views with
    any view; their points are not known yet.

    A track that reaches two keypoints of one view is none.
    """
    index = {view.name: k for k, view in enumerate(views)}
    ends: list[list[np.ndarray]] = [[], []]
    places: list[tuple[np.ndarray, np.ndarray]] = []
    for pair in sorted(matches):
        if not (pair[0] in index and pair[1] in index and set(pair) & set(fresh)):
            continue
        result = matches[pair]  # read from disk
        free, sides = np.ones(result.num_inliers, bool), []
        for side, xy in enumerate((result.keypoints0, result.keypoints1)):
            k = index[pair[side]]
            at = (xy + 0.5) / views[k].scale - 0.5
            free &= ~_taken(k, tracks, at)
            sides.append((k * 2**32 + result.cells[:, side].astype(np.int64), at))
        for end, (node, at) in zip(ends, sides, strict=True):
            end.append(node[free])
            places.append((node[free], at[free]))
    if not places:
        return Tracks(*(np.zeros(shape, kind) for shape, kind in _EMPTY))
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


_EMPTY = (((0, 3), np.float64), ((0,), np.int64), ((0,), np.int64), ((0, 2), np.float64))


def triangulated(views: list[View], tracks: Tracks) -> Tracks:
    """The points nearest to their observations' rays, by least squares of distances; NaN where the
    rays are parallel or less than two."""
    normal = np.zeros((len(tracks.points), 3, 3))
    right = np.zeros((len(tracks.points), 3))
    for k, view in enumerate(views):
        own = tracks.view == k
        ray = view.rays(tracks.xy[own])
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        np.add.at(normal, tracks.point[own], across)
        np.add.at(right, tracks.point[own], across @ view.centre)
    # Parallel rays leave the depth unknown: the least eigenvalue is the squared sine between them.
    solvable = np.linalg.eigvalsh(normal)[:, 0] > 1e-6
    points = np.full(tracks.points.shape, np.nan)
    points[solvable] = np.linalg.solve(normal[solvable], right[solvable, :, None])[..., 0]
    return tracks._replace(points=points)


def _agreeing(views: list[View], tracks: Tracks, max_error_px: float) -> Tracks:
    """Triangulated, without observations that are off, and without points that two no longer see;
    twice, for what was off had pulled."""
    for _ in range(2):
        tracks = triangulated(views, tracks)
        tracks = select(tracks, errors_px(views, tracks) <= max_error_px)
        seen = np.bincount(tracks.point, minlength=len(tracks.points))
        keep = (seen >= 2) & np.isfinite(tracks.points).all(1)
        tracks = select(tracks, keep[tracks.point])
        place = np.cumsum(keep) - 1
        tracks = tracks._replace(points=tracks.points[keep], point=place[tracks.point])
    return tracks


def new_points(
    views: list[View],
    tracks: Tracks,
    fresh: Collection[str],
    matches: Mapping[Pair, PairResult],
    read: Reader,
    *,
    refinement: Refinement | None,
) -> Tracks:
    """Points on which fresh views and others agree and that the model does not have.

    Args:
      tracks: of the model.
      fresh: names of views that are new in it.
      refinement: move the observations onto one patch each, as the model's were; None: they stay
        where they were matched.
    """
    found = _agreeing(views, matched_tracks(views, tracks, fresh, matches), MATCH_ERROR_PX)
    if refinement is None or len(found.points) < MIN_POINTS:
        return found
    parts = []
    for b in align_blocks(found, views, read, refinement, refinement.max_shift_px):
        good = np.flatnonzero(b.agrees)
        own = np.unique(b.found.point[good])
        parts.append((b.rows[own], b.reference[own], b.xy[own]))
        parts.append((b.rows[b.found.point[good]], b.found.view[good], b.moved[good]))
    point, view, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    aligned = Tracks(found.points, point, view, xy)
    return _agreeing(views, aligned, refinement.max_error_px)
