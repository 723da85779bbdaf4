"""The result of a localization: what is written as JSON, and the lines on the screen."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field
from typing import Literal, get_args

from jaxsfm.colmap.poses import CameraPose, Poses
from jaxsfm.colmap.view import View
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.report.typed_json import OMITTED, to_json
from jaxsfm.sfm.evaluation import PoseError, evaluate, pair_names
from jaxsfm.sfm.register.locate_view import Localization

Outcome = Literal["localized", "doubtful", "lost", "unusable"]
"""A trusted pose; a pose that rests on matches alone; no pose; a file that is no usable photo."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CamFromWorld:
    """A pose as COLMAP writes it: from the world to the camera."""

    rotation_wxyz: list[float]
    """A unit quaternion."""
    translation: list[float]
    """Units of the model."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhotoCamera:
    """The camera of a localized photo."""

    model: str
    """The name of a COLMAP camera model."""
    width: int
    """Pixels."""
    height: int
    params: list[float]
    """COLMAP's parameters, pixels."""
    source: str
    """Where the camera comes from: `given`, `run`, `exif` or `guess`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Confidence:
    """How far a pose can be trusted."""

    trusted: bool
    """Whether alignment confirms the pose."""
    centre_error: float | None
    """The expected error of the camera centre, units of the model."""
    rotation_error_deg: float | None
    """The expected error of the rotation, degrees."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class UnusablePhoto:
    """A file that is no usable photo."""

    photo: str
    """Its path, as it was given."""
    shortlist: list[str] | None = field(default=None, metadata=OMITTED)
    status: Outcome = "unusable"
    why: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocalizedPhoto:
    """What became of a usable photo (`jaxsfm.sfm.register.locate_view` explains the numbers)."""

    photo: str
    """Its path, as it was given."""
    in_run: str | None
    """The name of the same photo in the run; None if the run does not have it."""
    shortlist: list[str]
    """The photos of the run that it was matched with."""
    status: Outcome
    why: str | None
    """Why it has no pose, or none that is trusted."""
    matches: int
    on_surface: int
    """Matches with the surface of the model under them."""
    inliers: int
    """Those of `on_surface` that agree with the resection."""
    candidates: int
    """Points of the model that the photo could show."""
    agreed: int
    """Those of `candidates` that alignment finds."""
    octave_px: int | None
    """Working pixels per pixel of the octave that gives the pose; None if it is not trusted."""
    error_px: float | None
    """The median reprojection error of what determines the pose, working pixels."""
    doubt_px: float | None
    """The expected error of projections, working pixels."""
    confidence: Confidence
    cam_from_world: CamFromWorld | None = field(default=None, metadata=OMITTED)
    centre: list[float] | None = field(default=None, metadata=OMITTED)
    """The camera centre, units of the model."""
    camera: PhotoCamera | None = field(default=None, metadata=OMITTED)
    error: PoseError | None = field(default=None, metadata=OMITTED)
    """The error against the reference poses."""


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
        plain = to_json(self)
        assert isinstance(plain, dict)
        return plain


def _finite(value: float | None) -> float | None:
    """The number, or None if it is infinite: JSON has no infinity."""
    return value if value is not None and math.isfinite(value) else None


def _cam_from_world(view: View) -> CamFromWorld:
    moved = view.cam_from_world()
    x, y, z, w = (float(v) for v in moved.rotation.quat)
    return CamFromWorld(
        rotation_wxyz=[w, x, y, z], translation=[float(v) for v in moved.translation]
    )


def _camera(view: View, source: str) -> PhotoCamera:
    return PhotoCamera(
        model=view.camera.model_name,
        width=view.camera.width,
        height=view.camera.height,
        params=[float(v) for v in view.camera.params],
        source=source,
    )


def localized_photo(
    photo: str,
    found: Localization,
    matches: Mapping[Pair, PairResult],
    *,
    source: str,
    in_run: str | None,
    shortlist: Sequence[str],
    error: PoseError | None = None,
) -> LocalizedPhoto:
    """The row of a usable photo.

    Args:
      matches: the matches with the photos of the shortlist.
      source: where the photo's camera comes from.
    """
    view = found.view
    return LocalizedPhoto(
        photo=photo,
        in_run=in_run,
        shortlist=sorted(shortlist),
        status="localized" if found.trusted else "doubtful" if view else "lost",
        why=found.why,
        matches=sum(result.num_inliers for result in matches.values()),
        on_surface=found.on_surface,
        inliers=found.inliers,
        candidates=found.candidates,
        agreed=found.agreed,
        octave_px=found.octave_px,
        error_px=_finite(found.error_px),
        doubt_px=_finite(found.doubt_px),
        confidence=Confidence(
            trusted=found.trusted,
            centre_error=_finite(found.centre_error),
            rotation_error_deg=_finite(found.rotation_error_deg),
        ),
        cam_from_world=None if view is None else _cam_from_world(view),
        centre=None if view is None else [float(v) for v in view.centre],
        camera=None if view is None else _camera(view, source),
        error=error,
    )


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
    poses = {each.name: CameraPose(each.rotation, each.centre) for each in views}
    known = pair_names(poses, reference)
    others = {other: poses[other] for other in known if known[other] != partner}
    both = {**others, name: CameraPose(view.rotation, view.centre)}
    try:
        return evaluate(both, reference, align_on=sorted(others)).images[name]
    except UserError:  # there are too few others, or they lie on one line
        return None


def localize_lines(result: LocalizationReport) -> Iterator[str]:
    """The result as text: a few lines for each photo, and a last line with the totals."""
    for row in result.photos:
        name = shown_name(row.photo)
        if isinstance(row, UnusablePhoto) or row.centre is None:
            yield f"{row.status:10s} {name}: {row.why}"
            continue
        x, y, z = row.centre
        yield (
            f"{row.status:10s} {name}: centre {x:.4f} {y:.4f} {z:.4f}, "
            f"{row.inliers} of {row.on_surface} matches agree, "
            f"{row.agreed} of {row.candidates} points agree"
        )
        if row.why:
            yield f"{'':10s} {row.why}"
        confidence = row.confidence
        if confidence.centre_error is not None:
            yield (
                f"{'':10s} expected error {confidence.centre_error:.4f} units, "
                f"{confidence.rotation_error_deg:.3f} deg"
            )
        if row.in_run:
            yield (
                f"{'':10s} the run has this photo as {shown_name(row.in_run)}; its pose there was "
                "not used"
            )
        if row.error:
            yield (
                f"{'':10s} error {row.error.position:.4f} (units of the reference), "
                f"{row.error.rotation_deg:.4f} deg"
            )
    rows = result.photos
    counts = {status: sum(row.status == status for row in rows) for status in get_args(Outcome)}
    yield ", ".join(f"{n} {status}" for status, n in counts.items() if n) + f" of {len(rows)}"
