"""Two models that share photos, joined to one in a new folder (`jaxsfm merge`)."""

import dataclasses
import functools
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.given_model import (
    ModelFigures,
    figures_of,
    has_rigs,
    joined_cameras,
    looks_calibrated,
    read_given_model,
)
from jaxsfm.colmap.model import Model, point_colours, stored_sizes
from jaxsfm.colmap.poses import CameraPose, model_poses
from jaxsfm.colmap.reconstruction import coloured
from jaxsfm.errors import UserError
from jaxsfm.io.images import named
from jaxsfm.io.libraries import versions
from jaxsfm.options import check_threads
from jaxsfm.runs.refine import check_new_folder, write_new_folder
from jaxsfm.sfm.evaluation import pose_error
from jaxsfm.sfm.given_refinement import move_back
from jaxsfm.sfm.model_join import ERROR_PX, CommonFrame, Join, adjusted, find_join, joined

if TYPE_CHECKING:
    import pycolmap

REPORT = "merge.json"
MIN_SHARED = 2
"""The least number of photos that two models must share: one does not say how large a model is."""
ERROR_SHARE = 0.0025
"""The largest error of a right observation, as a share of the longer side of photos that are larger
than 1600 pixels."""
TURNED_DEG = 3.0
"""A shared photo whose directions in the two models differ by more lies elsewhere in the second."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MergeReport:
    """What was joined; `merge.json` holds the same."""

    models: list[str]
    """The two folders that were given."""
    before: list[ModelFigures]
    after: ModelFigures
    shared: int
    """The number of photos that both have."""
    common: int
    """The number of points that have the same keypoints in shared photos."""
    agreed: int
    """Those of them that fall together."""
    elsewhere: list[str]
    """Shared photos that lie elsewhere in the second model."""
    refined_intrinsics: bool
    versions: dict[str, str]


def merge_folders(
    first: Path,
    second: Path,
    out: Path,
    *,
    refine_intrinsics: Literal["auto", "yes", "no"] = "auto",
    threads: int = -1,
) -> MergeReport:
    """Join two COLMAP models that share photos, and write the result into a new folder.

    Args:
      first, second: folders of models, or folders that hold one (`find_model`).
        The result lies where the first model does.
      out: a new or empty folder.
      refine_intrinsics: whether focal lengths and distortion are adjusted. auto: unless the cameras
        of both models look calibrated.

    Raises:
      UserError: an input cannot be used, or the models share too little or do not agree.
    """
    check_threads(threads)
    check_new_folder(out)
    given = [read_given_model(path) for path in (first, second)]
    for path, model in zip((first, second), given, strict=True):
        if has_rigs(model):
            raise UserError(f"{path}: a model with rigs of several cameras cannot be merged")
    refines = refine_intrinsics == "yes" or (
        refine_intrinsics == "auto" and not all(map(looks_calibrated, given))
    )
    try:
        merged = merge_models(*given, refine_intrinsics=refines, threads=threads)
    except UserError as error:
        raise UserError(f"{first} and {second}: {error}") from error
    report = MergeReport(
        models=[str(first), str(second)],
        before=[figures_of(model) for model in given],
        after=figures_of(merged.model),
        shared=len(merged.join.shared),
        common=len(merged.join.points.first),
        agreed=merged.join.agreed,
        elsewhere=merged.elsewhere,
        refined_intrinsics=refines,
        versions=versions(),
    )
    write_new_folder(out, merged.model, REPORT, dataclasses.asdict(report))
    return report


def merge_lines(report: MergeReport) -> list[str]:
    """The summary of a merge: what the models hold before and after it."""
    lines = [f"{'':24s}{'first':>12s}{'second':>12s}{'merged':>12s}"]
    columns = [*report.before, report.after]
    for name, values in (
        ("images", [str(each.images) for each in columns]),
        ("points", [str(each.points) for each in columns]),
        ("observations", [str(each.observations) for each in columns]),
        ("mean track length", [f"{each.track_length:.2f}" for each in columns]),
        ("reprojection error, px", [f"{each.reprojection_error_px:.3f}" for each in columns]),
    ):
        lines.append(f"{name:24s}" + "".join(f"{value:>12s}" for value in values))
    lines.append(
        f"the models share {report.shared} photos, and {report.agreed} of {report.common} points "
        "that both have in them fall together"
    )
    if report.elsewhere:
        lines.append(
            f"elsewhere in the second model: {named(report.elsewhere)}; the first model's place "
            "was kept"
        )
    return lines


class Merged(NamedTuple):
    """Two models as one."""

    model: "pycolmap.Reconstruction"
    """In the frame of the first model. Common points that fall together are one point."""
    join: Join
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
    adjust = functools.partial(bundle_adjust, refine_intrinsics=refine_intrinsics, threads=threads)
    model = adjusted(both, adjust, error_px=error_px)
    move_back(model, model_poses(first))
    coloured(model, np.concatenate(before), colours)
    elsewhere = _elsewhere(a, b, join.shared, join.frame)
    return Merged(model, join, elsewhere)


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
