"""What became of localized photos, as plain JSON and as lines on the screen."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from jaxsfm.colmap.poses import CameraPose, Poses
from jaxsfm.colmap.view import View
from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.evaluation import evaluate, pair_names
from jaxsfm.sfm.register.locate_view import Localization

LOCALIZED, DOUBTFUL, LOST, UNUSABLE = "localized", "doubtful", "lost", "unusable"
"""A trusted pose; one that hangs on matches alone; none; not a photo."""


def _number(value: float | None) -> float | None:
    """JSON has no infinity."""
    return value if value is not None and math.isfinite(value) else None


def _pose(view: View) -> dict[str, Any]:
    """COLMAP's cam_from_world, and where that puts the camera."""
    moved = view.cam_from_world()
    x, y, z, w = (float(v) for v in moved.rotation.quat)
    return {
        "cam_from_world": {
            "rotation_wxyz": [w, x, y, z],
            "translation": [float(v) for v in moved.translation],
        },
        "centre": [float(v) for v in view.centre],
    }


def located_figures(
    found: Localization, source: str, matches: Mapping[Pair, PairResult]
) -> dict[str, Any]:
    """A photo's row, beside its names.

    Args:
      source: where its camera comes from.
    """
    view = found.view
    row: dict[str, Any] = {
        "status": LOCALIZED if found.trusted else DOUBTFUL if view else LOST,
        "why": found.why,
        "matches": sum(result.num_inliers for result in matches.values()),
        "on_surface": found.on_surface,
        "inliers": found.inliers,
        "candidates": found.candidates,
        "agreed": found.agreed,
        "octave_px": found.octave_px,
        "error_px": _number(found.error_px),
        "doubt_px": _number(found.doubt_px),
        "confidence": {
            "trusted": found.trusted,
            "centre_error": _number(found.centre_error),
            "rotation_error_deg": _number(found.rotation_error_deg),
        },
    }
    if view is not None:
        row |= _pose(view)
        row["camera"] = {
            "model": view.camera.model_name,
            "width": view.camera.width,
            "height": view.camera.height,
            "params": [float(v) for v in view.camera.params],
            "source": source,
        }
    return row


def error_against(
    name: str, view: View, views: Sequence[View], reference: Poses
) -> dict[str, float] | None:
    """How far a photo's pose is from the reference's, after the similarity that takes the model's
    other images to theirs; None if the reference does not know it.

    Args:
      name: what the reference calls the photo, or that with another suffix.
    """
    partner = pair_names([name], reference).get(name)
    if partner is None:
        return None
    poses = {each.name: CameraPose(each.rotation, each.centre) for each in views}
    known = pair_names(poses, reference)
    others = {other: poses[other] for other in known if known[other] != partner}
    both = {**others, name: CameraPose(view.rotation, view.centre)}
    try:
        error = evaluate(both, reference, align_on=sorted(others)).images[name]
    except UserError:  # too few others, or on one line
        return None
    return {"position": error.position, "rotation_deg": error.rotation_deg}


def localize_lines(result: Mapping[str, Any]) -> Iterator[str]:
    """The result as text: a few lines for each photo, and a last one."""
    rows = result["photos"]
    for row in rows:
        name = shown_name(row["photo"])
        if row["status"] in (UNUSABLE, LOST):
            yield f"{row['status']:10s} {name}: {row['why']}"
            continue
        x, y, z = row["centre"]
        confidence = row["confidence"]
        yield (
            f"{row['status']:10s} {name}: centre {x:.4f} {y:.4f} {z:.4f}, "
            f"{row['inliers']} of {row['on_surface']} matches, "
            f"{row['agreed']} of {row['candidates']} points agree"
        )
        if row["why"]:
            yield f"{'':10s} {row['why']}"
        if confidence["centre_error"] is not None:
            yield (
                f"{'':10s} expected error {confidence['centre_error']:.4f} units, "
                f"{confidence['rotation_error_deg']:.3f} deg"
            )
        if row["in_run"]:
            yield (f"{'':10s} it is {shown_name(row['in_run'])} of the run; that pose was not used")
        if row.get("error"):
            error = row["error"]
            yield (
                f"{'':10s} error {error['position']:.4f} (units of the reference), "
                f"{error['rotation_deg']:.4f} deg"
            )
    counts = {status: sum(row["status"] == status for row in rows) for status in STATUSES}
    yield ", ".join(f"{n} {status}" for status, n in counts.items() if n) + f" of {len(rows)}"


STATUSES = (LOCALIZED, DOUBTFUL, LOST, UNUSABLE)
