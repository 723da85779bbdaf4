"""Two models that share photos, joined to one."""

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.colmap.join_cameras import coloured, joined_cameras
from jaxsfm.colmap.model import Model, point_colours, stored_sizes
from jaxsfm.colmap.poses import CameraPose, model_poses
from jaxsfm.errors import UserError
from jaxsfm.io.images import named
from jaxsfm.sfm.common_frame import CommonFrame
from jaxsfm.sfm.evaluation import pose_error
from jaxsfm.sfm.model_join import ERROR_PX, adjusted, find_join, joined
from jaxsfm.sfm.old_frame import move_back

if TYPE_CHECKING:
    import pycolmap

MIN_SHARED = 2
"""The least number of photos that two models must share: one does not say how large a model is."""
ERROR_SHARE = 0.0025
"""The largest error of a right observation, as a share of the longer side of photos that are larger
than 1600 pixels."""
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
    a, b = (Model.from_colmap(each, stored_sizes(each)) for each in (first, second))
    names = {view.name for view in a.views}
    shared = names & {view.name for view in b.views}
    if len(shared) < MIN_SHARED:
        raise UserError(
            f"the models share {len(shared)} photos by name, and at least {MIN_SHARED} are needed "
            f"(the first model has e.g. {named(sorted(names))}, the second "
            f"{named(sorted(view.name for view in b.views))})"
        )
    longer = float(np.median([max(view.size) for view in a.views]))
    error_px = max(ERROR_PX, ERROR_SHARE * longer)
    join = find_join(a, b, error_px=error_px)
    if join.frame is None or join.agreed < join.needed:
        raise UserError(
            f"the models do not agree: of {len(join.points.first)} points that both have in "
            f"{len(shared)} shared photos, {join.agreed} fall together, and at least "
            f"{join.needed} must"
        )
    b = _with_new_ids(b, max(view.image_id for view in a.views) + 1)
    both = joined(a, b, join, joined_cameras(a, b, shared))
    colours = np.concatenate([point_colours(first), point_colours(second)])
    before = [a.tracks.points, join.frame.similarity.moved_points(b.tracks.points)]
    model = adjusted(both, error_px=error_px, refine_intrinsics=refine_intrinsics, threads=threads)
    move_back(model, model_poses(first))
    coloured(model, np.concatenate(before), colours)
    elsewhere = _elsewhere(a, b, join.shared, join.frame)
    return Merged(model, len(shared), len(join.points.first), join.agreed, elsewhere)


def _with_new_ids(model: Model, start: int) -> Model:
    """The model with other ids of its photos, from `start` on."""
    views = [dataclasses.replace(view, image_id=start + k) for k, view in enumerate(model.views)]
    return model.with_views(views)


def _pose(model: Model, name: str) -> CameraPose:
    return next(view for view in model.views if view.name == name).pose


def _elsewhere(a: Model, b: Model, shared: list[str], frame: CommonFrame) -> list[str]:
    return [
        name
        for name in shared
        if pose_error(frame.similarity.moved(_pose(b, name)), _pose(a, name)).rotation_deg
        > TURNED_DEG
    ]
