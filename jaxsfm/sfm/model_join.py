"""Two models that share photos as one model: how they lie, and whether they agree."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.sfm.evaluation import Similarity, umeyama
from jaxsfm.sfm.view_graph import mean_rotation

if TYPE_CHECKING:
    import pycolmap

MIN_COMMON = 15
"""The least number of common points that fall together: that of COLMAP's mapper for a pair."""
MIN_SHARE = 0.5
"""The least share of the common points that fall together."""
ERROR_PX = 4.0
"""The largest error of a right observation in pixels, as in COLMAP."""
COARSE = 4.0
"""The first adjustment has observations whose error is up to so many times larger."""
REACH_PX = 2.0
"""Two keypoints of a shared photo are the same if they are this near. Features of one kind lie at
the same place in both models, except for what the refinement moved."""
TRIES = 300
"""The number of pairs of shared photos that are tried."""
SAMPLE = 2000
"""The number of common points that judge a try."""


class CommonPoints(NamedTuple):
    """Points that both models have: point `first[k]` is point `second[k]`."""

    first: np.ndarray
    """int (n,), each once."""
    second: np.ndarray
    """int (n,), each once."""

    def select(self, rows: np.ndarray) -> "CommonPoints":
        """Some of the points, by a mask or indices."""
        return CommonPoints(self.first[rows], self.second[rows])


class CommonFrame(NamedTuple):
    """Where the second model lies in the frame of the first one."""

    similarity: Similarity
    """It takes the second model's world to the first one's."""
    agree: np.ndarray
    """bool (n,): which common points fall together."""


def common_points(first: Model, second: Model, shared: Sequence[str]) -> CommonPoints:
    """The points that have the same keypoints in shared photos.

    A point may meet several of the other model; the one that it meets in most photos counts.
    """
    met = [np.zeros((0, 2), np.int64)]
    for name in shared:
        sides = []
        for model in (first, second):
            view = next(k for k, view in enumerate(model.views) if view.name == name)
            rows = model.rows[view]
            sides.append((model.tracks.point[rows], model.tracks.xy[rows]))
        (point0, xy0), (point1, xy1) = sides
        if not len(xy0) or not len(xy1):
            continue
        distance, to = map(np.asarray, KDTree(xy1).query(xy0))
        back = np.asarray(KDTree(xy0).query(xy1)[1])
        mutual = np.flatnonzero((distance <= REACH_PX) & (back[to] == np.arange(len(to))))
        met.append(np.stack([point0[mutual], point1[to[mutual]]], axis=1))
    rows, times = np.unique(np.concatenate(met), axis=0, return_counts=True)
    rows = rows[np.argsort(-times, kind="stable")]
    once0, once1 = (np.unique(column, return_index=True)[1] for column in rows.T)
    rows = rows[np.intersect1d(once0, once1)]
    return CommonPoints(rows[:, 0], rows[:, 1])


def find_frame(
    first: Model, second: Model, shared: Sequence[str], points: CommonPoints, *, error_px: float
) -> CommonFrame | None:
    """The similarity with which most common points fall together; None without any.

    Every pair of shared photos gives one: their rotations turn the model, and the distance of their
    positions scales it. The best one is then fitted to all points that agree.

    Args:
      error_px: points fall together if the second model's point, in the photos of the first model
        that observe it, is this near to its keypoints in the mean, pixels of the views.
    """
    if not len(points.first):
        return None
    sides = [
        {view.name: view for view in model.views if view.name in shared}
        for model in (first, second)
    ]
    turns = {name: sides[0][name].rotation.T @ sides[1][name].rotation for name in shared}
    centres = [{name: side[name].centre for name in shared} for side in sides]

    def baseline(pair: tuple[str, str], which: int) -> float:
        return float(np.linalg.norm(centres[which][pair[0]] - centres[which][pair[1]]))

    pairs = [p for p in itertools.combinations(sorted(shared), 2) if baseline(p, 1) > 0]
    pairs.sort(key=lambda pair: -baseline(pair, 0))
    some = points.select(np.unique(np.linspace(0, len(points.first) - 1, SAMPLE).astype(int)))
    best: Similarity | None = None
    most = 0
    for pair in pairs[:TRIES]:
        scale = baseline(pair, 0) / baseline(pair, 1)
        if not scale > 0:
            continue
        turn = mean_rotation(np.asarray([turns[name] for name in pair]), np.ones(2))
        middle = [np.mean([each[name] for name in pair], axis=0) for each in centres]
        tried = Similarity(scale, turn, middle[0] - scale * turn @ middle[1])
        count = int(_agree(first, second, some, tried, error_px).sum())
        if count > most:
            best, most = tried, count
    if best is None:
        return None
    agree = _agree(first, second, points, best, error_px)
    if agree.sum() >= 3:
        own = second.tracks.points[points.second[agree]], first.tracks.points[points.first[agree]]
        fitted = umeyama(*own)
        better = _agree(first, second, points, fitted, error_px)
        if better.sum() > agree.sum():
            best, agree = fitted, better
    return CommonFrame(best, agree)


def _agree(
    first: Model, second: Model, points: CommonPoints, by: Similarity, error_px: float
) -> np.ndarray:
    """bool (n,): which common points fall together."""
    tracks, count = first.tracks, len(points.first)
    place = np.full(len(tracks.points), -1)
    place[points.first] = np.arange(count)
    rows = np.flatnonzero(place[tracks.point] >= 0)
    point = place[tracks.point[rows]]
    at = by.moved_points(second.tracks.points[points.second])
    errors = first.with_tracks(Tracks(at, point, tracks.view[rows], tracks.xy[rows])).errors_px()
    total = np.bincount(point, errors, count)
    return total < error_px * np.bincount(point, minlength=count)


class Join(NamedTuple):
    """What two models have in common."""

    shared: list[str]
    """The photos of both, sorted."""
    points: CommonPoints
    """Points that have the same keypoints in shared photos."""
    frame: CommonFrame | None
    """Where the second model lies in the frame of the first one."""

    @property
    def agreed(self) -> int:
        """The number of common points that fall together."""
        return int(self.frame.agree.sum()) if self.frame else 0

    @property
    def needed(self) -> int:
        """The number of common points that must fall together."""
        return max(MIN_COMMON, round(MIN_SHARE * len(self.points.first)))


def find_join(first: Model, second: Model, *, error_px: float) -> Join:
    """What two models have in common.

    Args:
      error_px: points fall together if they are this near in the photos, pixels of the views.
    """
    names = ({view.name for view in model.views} for model in (first, second))
    shared = sorted(set.intersection(*names))
    points = common_points(first, second, shared)
    return Join(shared, points, find_frame(first, second, shared, points, error_px=error_px))


def joined(
    first: Model, second: Model, join: Join, cameras: Mapping[int, "pycolmap.Camera"]
) -> Model:
    """The first model with the photos, points and observations that only the second one has.

    Args:
      join: with a frame.
      cameras: those that stand for the cameras of the second model, by their ids.
    """
    frame = join.frame
    assert frame is not None
    number = {view.name: k for k, view in enumerate(first.views)}
    views, place = list(first.views), np.zeros(len(second.views), np.int64)
    for k, view in enumerate(second.views):
        if view.name in number:
            place[k] = number[view.name]
            continue
        place[k] = len(views)
        moved = view.at(frame.similarity.moved(view.pose))
        views.append(dataclasses.replace(moved, camera=cameras[view.camera.camera_id]))
    same = join.points.select(frame.agree)
    target = np.full(len(second.tracks.points), -1)
    target[same.second] = same.first
    alone = np.flatnonzero(target < 0)
    target[alone] = len(first.tracks.points) + np.arange(len(alone))
    added = frame.similarity.moved_points(second.tracks.points[alone])
    point, view = target[second.tracks.point], place[second.tracks.view]
    taken = first.tracks.point * len(views) + first.tracks.view
    new = np.flatnonzero(~np.isin(point * len(views) + view, taken))
    tracks = Tracks(
        np.concatenate([first.tracks.points, added]),
        np.concatenate([first.tracks.point, point[new]]),
        np.concatenate([first.tracks.view, view[new]]),
        np.concatenate([first.tracks.xy, second.tracks.xy[new]]),
    )
    return dataclasses.replace(first, views=views, tracks=tracks)


def adjusted(
    model: Model, adjust: Callable[..., None], *, error_px: float
) -> "pycolmap.Reconstruction":
    """Filter the observations and adjust the bundle, twice; the first filter is coarse.

    Args:
      adjust: `jaxsfm.colmap.bundle_adjustment.bundle_adjust` with all arguments but `loss_px`.
      error_px: the largest error of a right observation, pixels of the views.
    """

    def once(slack: float) -> "pycolmap.Reconstruction":
        made = model.select(model.errors_px() < slack * error_px).to_colmap()
        # A larger error at first, so that what is far off still pulls.
        loss_px = max(slack / 4, 1.0) * error_px / 4
        adjust(made, loss_px=loss_px)
        return made

    model = Model.from_colmap(once(COARSE), model.sizes)
    return once(1.0)
