"""Two models that share photos as one model: whether they agree, and what the one looks like."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.sfm.common_frame import (
    CommonFrame,
    CommonPoints,
    common_points,
    find_frame,
)

if TYPE_CHECKING:
    import pycolmap

MIN_SHARED = 3
"""The least number of photos that two models must share. Two share a pair, which may be false in
both models."""
MIN_COMMON = 15
"""The least number of common points that fall together: that of COLMAP's mapper for a pair."""
MIN_SHARE = 0.5
"""The least share of the common points that fall together."""
ERROR_PX = 4.0
"""The largest error of a right observation in pixels, as in COLMAP."""
COARSE = 4.0
"""The first adjustment has observations whose error is up to so many times larger."""


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
    model: Model, *, error_px: float, refine_intrinsics: bool, threads: int
) -> "pycolmap.Reconstruction":
    """Filter the observations and adjust the bundle, twice; the first filter is coarse.

    Args:
      error_px: the largest error of a right observation, pixels of the views.
    """

    def once(slack: float) -> "pycolmap.Reconstruction":
        made = model.select(model.errors_px() < slack * error_px).to_colmap()
        # A larger error at first, so that what is far off still pulls.
        loss_px = max(slack / 4, 1.0) * error_px / 4
        bundle_adjust(made, loss_px=loss_px, refine_intrinsics=refine_intrinsics, threads=threads)
        return made

    model = Model.from_colmap(once(COARSE), model.sizes)
    return once(1.0)
