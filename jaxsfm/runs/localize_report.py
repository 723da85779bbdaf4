"""The result of a localization: what is written as JSON, and the lines on the screen."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Literal, get_args

from jaxsfm.colmap.poses import Poses
from jaxsfm.colmap.view import View
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.images import shown_name
from jaxsfm.report.typed_json import to_json
from jaxsfm.sfm.evaluation import PoseError, evaluate, pair_names
from jaxsfm.sfm.register.locate_view import Localization

Outcome = Literal["localized", "doubtful", "lost", "unusable"]
"""A trusted pose; a pose that rests on matches alone; no pose; a file that is no usable photo."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class UnusablePhoto:
    """A file that is no usable photo."""

    photo: str
    """Its path, as it was given."""
    why: str
    shortlist: Sequence[str] | None = None
    """The photos of the run that it should have been matched with; None if it has no shortlist."""
    status: Outcome = "unusable"

    def to_json(self) -> dict[str, Json]:
        """The row as plain JSON."""
        shortlist = {} if self.shortlist is None else {"shortlist": sorted(self.shortlist)}
        return {"photo": self.photo, **shortlist, "status": self.status, "why": self.why}


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocalizedPhoto:
    """What became of a usable photo."""

    photo: str
    """Its path, as it was given."""
    in_run: str | None
    """The name of the same photo in the run; None if the run does not have it."""
    shortlist: Sequence[str]
    """The photos of the run that it was matched with."""
    matches: int
    """The number of all its matches."""
    source: str
    """Where its camera comes from: `given`, `run`, `exif` or `guess`."""
    model: int
    """The number N of the model sparse/N that the pose is in."""
    found: Localization
    error: PoseError | None = None
    """The error against the reference poses."""

    @property
    def status(self) -> Outcome:
        """The outcome in one word."""
        if self.found.trusted:
            return "localized"
        return "doubtful" if self.found.view else "lost"

    def to_json(self) -> dict[str, Json]:
        """The row as plain JSON. JSON has no infinity: infinite errors are null."""
        found, view = self.found, self.found.view
        row: dict[str, Json] = {
            "photo": self.photo,
            "in_run": self.in_run,
            "in_model": self.model,
            "shortlist": sorted(self.shortlist),
            "status": self.status,
            "why": found.why,
            "matches": self.matches,
            "on_surface": found.on_surface,
            "inliers": found.inliers,
            "candidates": found.candidates,
            "agreed": found.agreed,
            "octave_px": found.octave_px,
            "error_px": _finite(found.error_px),
            "uncertainty_px": _finite(found.uncertainty_px),
            "confidence": {
                "trusted": found.trusted,
                "centre_error": _finite(found.centre_error),
                "rotation_error_deg": _finite(found.rotation_error_deg),
            },
        }
        if view is not None:
            row |= _pose_and_camera(view, self.source)
        if self.error is not None:
            row["error"] = to_json(self.error)
        return row


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _pose_and_camera(view: View, source: str) -> dict[str, Json]:
    """The pose of a photo as COLMAP writes it, from the world to the camera, and its camera with
    COLMAP's parameters."""
    moved, camera = view.cam_from_world(), view.camera
    x, y, z, w = moved.rotation.quat.tolist()
    return {
        "cam_from_world": {
            "rotation_wxyz": [w, x, y, z],
            "translation": moved.translation.tolist(),
        },
        "centre": view.centre.tolist(),
        "camera": {
            "model": camera.model_name,
            "width": camera.width,
            "height": camera.height,
            "params": [float(v) for v in camera.params],
            "source": source,
        },
    }


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocalizationReport:
    """The result of one call of `localize`."""

    version: str
    """The version of jaxsfm."""
    model: str
    """The absolute path of the run."""
    photos: list[LocalizedPhoto | UnusablePhoto]
    """Sorted by path."""

    def to_json(self) -> dict[str, Json]:
        """The result as plain JSON."""
        rows: list[Json] = [photo.to_json() for photo in self.photos]
        return {"version": self.version, "model": self.model, "photos": rows}


def error_against(
    name: str, view: View, views: Sequence[View], reference: Poses
) -> PoseError | None:
    """The error of a photo's pose against reference poses.

    The model is first moved onto the reference by the similarity that fits its other photos best.

    Args:
      name: the name of the photo in the reference, up to its suffix.
      views: the views of the model.

    Returns:
      None if the reference does not have the photo, or too few others to fit the similarity.
    """
    partner = pair_names([name], reference).get(name)
    if partner is None:
        return None
    poses = {each.name: each.pose for each in views}
    known = pair_names(poses, reference)
    others = {other: poses[other] for other in known if known[other] != partner}
    both = {**others, name: view.pose}
    try:
        return evaluate(both, reference, align_on=sorted(others)).images[name]
    except UserError:  # there are too few others, or they lie on one line
        return None


def localize_lines(result: LocalizationReport) -> Iterator[str]:
    """The result as text: a few lines for each photo, and a last line with the totals."""
    for row in result.photos:
        yield from _photo_lines(row)
    rows = result.photos
    counts = {status: sum(row.status == status for row in rows) for status in get_args(Outcome)}
    yield ", ".join(f"{n} {status}" for status, n in counts.items() if n) + f" of {len(rows)}"


def _photo_lines(row: LocalizedPhoto | UnusablePhoto) -> Iterator[str]:
    start = f"{row.status:10s} {shown_name(row.photo)}: "
    if isinstance(row, UnusablePhoto):
        yield start + row.why
        return
    found, indent = row.found, " " * 11
    if found.view is None:
        yield f"{start}{found.why}"
        return
    x, y, z = found.view.centre
    where = f"in sparse/{row.model}, " if row.model else ""
    yield (
        f"{start}{where}centre {x:.4f} {y:.4f} {z:.4f}, "
        f"{found.inliers} of {found.on_surface} matches agree, "
        f"{found.agreed} of {found.candidates} points agree"
    )
    if found.why:
        yield indent + found.why
    if _finite(found.centre_error) is not None:
        yield (
            f"{indent}expected error {found.centre_error:.4f} units, "
            f"{found.rotation_error_deg:.3f} deg"
        )
    if row.in_run:
        yield (
            f"{indent}the run has this photo as {shown_name(row.in_run)}; its pose there was not "
            "used"
        )
    if row.error:
        yield (
            f"{indent}error {row.error.position:.4f} (units of the reference), "
            f"{row.error.rotation_deg:.4f} deg"
        )
