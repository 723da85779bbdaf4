"""The refinement of a model of any tool, from its folder to a new folder (`jaxsfm refine`)."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tqdm import tqdm

from jaxsfm.colmap.given_model import (
    ModelFigures,
    figures_of,
    looks_calibrated,
    read_given_model,
    shares_cameras,
)
from jaxsfm.colmap.model_files import write_model
from jaxsfm.config import Config, Refinement
from jaxsfm.errors import UserError, writing
from jaxsfm.io.atomic import atomic_folder
from jaxsfm.io.entries import named_place
from jaxsfm.io.images import shown_name
from jaxsfm.io.libraries import versions
from jaxsfm.options import check_threads
from jaxsfm.sfm.given_refinement import GivenRefinement, ModelPhotos, refine_given
from jaxsfm.sfm.refine.one_pass import PassSettings
from jaxsfm.sfm.refine.passes import RefinementFigures

if TYPE_CHECKING:
    import pycolmap

REPORT = "refine.json"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """How a model is refined."""

    config: Config = Config(refinement=Refinement())
    """Its `max_size` and its `refinement` count."""
    refine_intrinsics: Literal["auto", "yes", "no"] = "auto"
    """auto: if photos share cameras, unless these look calibrated. The focal length of a single
    photo is not known better after the refinement: on the four Strecha sets with a camera for each
    photo, position errors were 0.79, 0.77, 1.31 and 1.39 times those of the given models with
    refined intrinsics, and 1.01, 1.02, 1.00 and 0.95 times without."""
    threads: int = -1
    progress: bool = False
    """Whether a progress bar is shown on standard error."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraChange:
    """The parameters of a camera before and after the refinement, as COLMAP writes them."""

    model: str
    before: list[float]
    after: list[float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefineReport:
    """What a refinement did; `refine.json` holds the same."""

    model: str
    """The folder that was given."""
    images: str
    refined_intrinsics: bool
    before: ModelFigures
    after: ModelFigures
    refinement: RefinementFigures
    unread: dict[str, str]
    """Name -> why the photo could not be read. Its observations were not aligned."""
    removed: list[str]
    """The images that were taken out, because next to nothing of them agreed."""
    cameras: dict[int, CameraChange]
    """By id."""
    max_size: int
    settings: Refinement
    versions: dict[str, str]


def refine_folder(
    path: Path, images: Path, out: Path, *, options: RefineOptions
) -> RefineReport | None:
    """Refine a COLMAP model, and write the new model and `refine.json` into a new folder.

    Nothing is written, and the result is None, if too little of the model agrees with the photos.

    Args:
      path: the folder of a model, or one that holds a model (`find_model`).
      images: the folder of the photos.
      out: a new or empty folder.

    Raises:
      UserError: an input cannot be used.
    """
    check_threads(options.threads)
    check_new_folder(out)
    given = read_given_model(path)
    settings = options.config.refinement or Refinement()
    photos = ModelPhotos(given, images, options.config)
    refines = options.refine_intrinsics == "yes" or (
        options.refine_intrinsics == "auto"
        and shares_cameras(given)
        and not looks_calibrated(given)
    )
    with tqdm(desc="refining", unit="pass", disable=not options.progress, delay=2) as bar:

        def passed() -> None:
            bar.update()

        found = refine_given(
            given,
            photos,
            PassSettings(settings, refines, options.threads),
            on_pass=passed,
        )
    if found is None:
        return None
    report = RefineReport(
        model=str(path),
        images=str(images),
        refined_intrinsics=refines,
        before=figures_of(given),
        after=figures_of(found.model),
        refinement=found.figures,
        unread=photos.unread,
        removed=_removed(given, found),
        cameras=_changes(given, found),
        max_size=options.config.max_size,
        settings=settings,
        versions=versions(),
    )
    write_new_folder(out, found.model, REPORT, dataclasses.asdict(report))
    return report


def check_new_folder(out: Path) -> None:
    """Check, before the work is done, that `--out` can become a new folder.

    Raises:
      UserError: there is a file or a folder with something in it, or the place cannot be written.
    """
    with writing(f"--out {out}"):
        place = named_place(out)
        if out.exists() and not (out.is_dir() and not any(out.iterdir())):
            raise UserError(f"--out {out}: not empty; choose an empty or new folder")
        place.parent.mkdir(parents=True, exist_ok=True)


def write_new_folder(
    out: Path, model: "pycolmap.Reconstruction", name: str, report: dict[str, Any]
) -> None:
    """Write a model and the file `name` with its report into the new folder `--out`.

    Raises UserError if the folder cannot be written, or the disk is too small.
    """
    with writing(f"--out {out}"), atomic_folder(named_place(out)) as fresh:
        write_model(model, fresh)
        (fresh / name).write_text(json.dumps(report, indent=1), encoding="utf-8")


def _removed(given: "pycolmap.Reconstruction", found: GivenRefinement) -> list[str]:
    left = {found.model.image(image_id).name for image_id in found.model.reg_image_ids()}
    return sorted({given.image(image_id).name for image_id in given.reg_image_ids()} - left)


def _changes(given: "pycolmap.Reconstruction", found: GivenRefinement) -> dict[int, CameraChange]:
    return {
        camera_id: CameraChange(
            model=camera.model_name,
            before=[float(value) for value in camera.params],
            after=[float(value) for value in found.model.camera(camera_id).params],
        )
        for camera_id, camera in sorted(given.cameras.items())
    }


def refine_lines(report: RefineReport) -> list[str]:
    """The summary of a refinement: what the model holds before and after it."""
    before, after, passes = report.before, report.after, report.refinement.passes
    rows = [
        ("images", str(before.images), str(after.images)),
        ("points", str(before.points), str(after.points)),
        ("observations", str(before.observations), str(after.observations)),
        ("mean track length", f"{before.track_length:.2f}", f"{after.track_length:.2f}"),
        (
            "reprojection error, px",
            f"{before.reprojection_error_px:.3f}",
            f"{after.reprojection_error_px:.3f}",
        ),
    ]
    lines = [f"{'':24s}{'before':>12s}{'after':>12s}"]
    lines += [f"{name:24s}{old:>12s}{new:>12s}" for name, old, new in rows]
    for number, done in enumerate(passes, 1):
        shift = done.shift_px or 0.0
        lines.append(
            f"pass {number}: {done.kept} observations agreed and moved by {shift:.2f} px "
            f"on average, {done.dropped} were dropped, {done.added} added"
            + ("" if done.accepted else "; too few agreed, so this pass was taken back")
        )
    intrinsics = "were refined" if report.refined_intrinsics else "stayed as they were"
    lines.append(f"intrinsics {intrinsics}")
    if report.refinement.camera is not None:
        lines.append(f"camera: {report.refinement.camera.in_words()}")
    lines += [f"not read: {reason}" for reason in report.unread.values()]
    for at in report.refinement.registrations:
        if at.name in report.removed:
            lines.append(f"taken out: {shown_name(at.name)}: next to nothing of it agrees")
        elif at.octave_px is None and at.name not in report.unread:
            lines.append(f"not aligned: {shown_name(at.name)}: it keeps its observations")
    return lines
