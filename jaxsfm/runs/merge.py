"""Two models that share photos, joined to one in a new folder (`jaxsfm merge`)."""

import dataclasses
from pathlib import Path
from typing import Literal

from jaxsfm.colmap.given_model import ModelFigures, figures_of, looks_calibrated, read_given_model
from jaxsfm.colmap.updated_model import has_rigs
from jaxsfm.errors import UserError
from jaxsfm.io.images import named
from jaxsfm.io.libraries import versions
from jaxsfm.options import check_threads
from jaxsfm.runs.refine import check_new_folder, write_new_folder
from jaxsfm.sfm.merged_models import merge_models

REPORT = "merge.json"


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
      first, second: folders of models, or folders that hold one (`jaxsfm.colmap.poses.find_model`).
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
        shared=merged.shared,
        common=merged.common,
        agreed=merged.agreed,
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
