"""Two models that share photos, joined to one."""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.join_cameras import coloured, joined_cameras
from jaxsfm.colmap.model import Model, point_colours
from jaxsfm.colmap.poses import CameraPose, model_poses
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.errors import UserError
from jaxsfm.io.images import named
from jaxsfm.sfm.common_frame import (
    CommonFrame,
    CommonPoints,
    common_points,
    find_frame,
    moved_points,
)
from jaxsfm.sfm.evaluation import pose_error
from jaxsfm.sfm.old_frame import move_back

if TYPE_CHECKING:
    import pycolmap

MIN_SHARED = 2
"""The least number of photos that two models must share: one does not say how large a model is."""
MIN_COMMON = 15
"""The least number of common points that fall together: that of COLMAP's mapper for a pair."""
MIN_SHARE = 0.5
"""The least share of the common points that fall together."""
ERROR_PX, ERROR_SHARE = 4.0, 0.0025
"""The largest error of a right observation in pixels, as in COLMAP, and as a share of the longer
side of photos that are larger than 1600 pixels."""
TURNED_DEG = 3.0
"""A shared photo whose directions in the two models differ by more lies elsewhere in the second."""


class Merged(NamedTuple):
    """Two models as one."""

    model: "pycolmap.Reconstruction"
    """In the frame of the first model."""
    shared: int
    """The number of photos that both have."""
    common: int
    """The number of points that have the same keypoints in shared photos."""
    agreed: int
    """Those of them that fall together. They are one point in the joined model."""
    elsewhere: list[str]
    """Shared photos that lie elsewhere in the second model. They stay where the first has them."""


def merge_models(
    first: "pycolmap.Reconstruction",
    second: "pycolmap.Reconstruction",
    *,
    refine_intrinsics: bool,
    threads: int,
) -> Merged:
    """Join the second model to the first one, and adjust the result.

    Photos and cameras of the first model keep their ids; those that only the second one has get new
    ones. Every photo gets a frame of its own.

    Raises:
      UserError: the models share too few photos or points, or too few of these fall together.
    """
    a, b = (Model.from_colmap(each, _sizes(each)) for each in (first, second))
    names = {view.name for view in a.views}
    shared = sorted(names & {view.name for view in b.views})
    if len(shared) < MIN_SHARED:
        raise UserError(
            f"the models share {len(shared)} photos by name, and at least {MIN_SHARED} are needed "
            f"(the first model has e.g. {named(sorted(names))}, the second "
            f"{named(sorted(view.name for view in b.views))})"
        )
    points = common_points(a, b, shared)
    longer = float(np.median([max(view.size) for view in a.views]))
    limit_px = max(ERROR_PX, ERROR_SHARE * longer)
    frame = find_frame(a, b, shared, points, error_px=limit_px)
    agreed = int(frame.agree.sum()) if frame else 0
    if frame is None or agreed < max(MIN_COMMON, MIN_SHARE * len(points.first)):
        raise UserError(
            f"the models do not agree: of {len(points.first)} points that both have in "
            f"{len(shared)} shared photos, {agreed} fall together, and at least "
            f"{max(MIN_COMMON, round(MIN_SHARE * len(points.first)))} must"
        )
    joined = _joined(a, b, frame, points)
    colours = np.concatenate([point_colours(first), point_colours(second)])
    before = [a.tracks.points, moved_points(b.tracks.points, frame.similarity)]
    model = _adjusted(joined, limit_px, refine_intrinsics, threads)
    move_back(model, model_poses(first))
    coloured(model, np.concatenate(before), colours)
    return Merged(model, len(shared), len(points.first), agreed, _elsewhere(a, b, shared, frame))


def _sizes(model: "pycolmap.Reconstruction") -> dict:
    """The sizes of the photos, as they are stored."""
    sizes = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        camera = model.camera(image.camera_id)
        sizes[image.name] = (camera.width, camera.height), (1.0, 1.0)
    return sizes


def _pose(model: Model, name: str) -> CameraPose:
    view = next(view for view in model.views if view.name == name)
    return CameraPose(view.rotation, view.centre)


def _elsewhere(a: Model, b: Model, shared: list[str], frame: CommonFrame) -> list[str]:
    return [
        name
        for name in shared
        if pose_error(frame.similarity.moved(_pose(b, name)), _pose(a, name)).rotation_deg
        > TURNED_DEG
    ]


def _joined(a: Model, b: Model, frame: CommonFrame, points: CommonPoints) -> Model:
    """The first model with the photos, points and observations that only the second one has."""
    number = {view.name: k for k, view in enumerate(a.views)}
    cameras = joined_cameras(a, b, number.keys() & {view.name for view in b.views})
    views, place = list(a.views), np.zeros(len(b.views), np.int64)
    image_id = max(view.image_id for view in a.views)
    for k, view in enumerate(b.views):
        if view.name in number:
            place[k] = number[view.name]
            continue
        image_id += 1
        pose = frame.similarity.moved(CameraPose(view.rotation, view.centre))
        place[k] = len(views)
        views.append(
            dataclasses.replace(
                view,
                image_id=image_id,
                rotation=pose.rotation,
                centre=pose.centre,
                camera=cameras[view.camera.camera_id],
            )
        )
    same = points.select(frame.agree)
    target = np.full(len(b.tracks.points), -1)
    target[same.second] = same.first
    alone = np.flatnonzero(target < 0)
    target[alone] = len(a.tracks.points) + np.arange(len(alone))
    added = moved_points(b.tracks.points[alone], frame.similarity)
    point, view = target[b.tracks.point], place[b.tracks.view]
    taken = a.tracks.point * len(views) + a.tracks.view
    new = np.flatnonzero(~np.isin(point * len(views) + view, taken))
    tracks = Tracks(
        np.concatenate([a.tracks.points, added]),
        np.concatenate([a.tracks.point, point[new]]),
        np.concatenate([a.tracks.view, view[new]]),
        np.concatenate([a.tracks.xy, b.tracks.xy[new]]),
    )
    return dataclasses.replace(a, views=views, tracks=tracks)


def _adjusted(
    model: Model, limit_px: float, refine_intrinsics: bool, threads: int
) -> "pycolmap.Reconstruction":
    """Filter the observations and adjust the bundle, twice; the first filter is coarse."""

    def once(slack: float) -> "pycolmap.Reconstruction":
        made = model.select(model.errors_px() < slack * limit_px).to_colmap()
        bundle_adjust(
            made, loss_px=limit_px / 4, refine_intrinsics=refine_intrinsics, threads=threads
        )
        return made

    model = Model.from_colmap(once(4.0), model.sizes)
    return once(1.0)
