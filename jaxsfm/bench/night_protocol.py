"""The paper's night protocol (section 4.1): what is measured of a night photo among day photos."""

from collections.abc import Sequence
from typing import NotRequired, TypedDict

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsfm.bench.scenes import Subset
from jaxsfm.bench.subset_models import SubsetModel
from jaxsfm.colmap.poses import Poses
from jaxsfm.errors import UserError
from jaxsfm.sfm.evaluation import common_alignment, pose_error

LIMITS = ((0.1, 1.0), (0.5, 10.0), (1.0, 10.0), (5.0, 10.0), (10.0, 10.0), (20.0, 10.0))
"""Limits of the position error (units of the reference, metres for Strecha and Aachen) and of the
rotation error (degrees)."""


class SubsetRow(TypedDict):
    """The figures of one subset."""

    night: str
    """The name of the night photo."""
    registered: bool
    has_truth: bool
    """Whether the night photo has a reference pose."""
    day_registered: int
    day_images: int
    matches: NotRequired[int]
    correct: NotRequired[int]
    not_evaluated: NotRequired[str]
    pose: NotRequired[list[float]]
    """qw qx qy qz tx ty tz: rotation and translation from the reference's world to the night
    camera."""
    position: NotRequired[float]
    rotation_deg: NotRequired[float]


class Summary(TypedDict):
    """The figures of several subsets."""

    nights: int
    night_registered: int
    day_images: int
    day_registered: int
    matches: int | None
    correct: int | None
    nights_with_reference: int
    """The number of nights that `within` counts, registered or not."""
    within: dict[str, float] | None
    not_evaluated: int
    sorted_positions: list[float]
    """The position errors of the nights that were evaluated, units of the reference."""
    sorted_rotations_deg: list[float]


def judge(made: SubsetModel, subset: Subset, truth: Poses) -> SubsetRow:
    """Count a subset's registered cameras and matches, and measure the night camera's errors."""
    poses = made.poses
    day = [name for name in subset.day if name in poses]
    row: SubsetRow = {
        "night": subset.night,
        "registered": subset.night in poses,
        "has_truth": subset.night in truth,
        "day_registered": len(day),
        "day_images": len(subset.day),
    }
    if made.matches is not None:
        row["matches"], row["correct"] = made.matches.number, made.matches.correct
    if not row["registered"]:
        return row
    known = {name: truth[name] for name in day if name in truth}
    try:
        _, _, similarity = common_alignment({name: poses[name] for name in known}, known)
    except UserError as error:  # too few day cameras, or all on one line
        row["not_evaluated"] = str(error)
        return row
    night = similarity.moved(poses[subset.night])
    quaternion = np.roll(Rotation.from_matrix(night.rotation).as_quat(), 1)
    row["pose"] = [*quaternion.tolist(), *(-night.rotation @ night.centre).tolist()]
    if subset.night in truth:
        error = pose_error(night, truth[subset.night])
        row["position"], row["rotation_deg"] = error.position, error.rotation_deg
    return row


def limit_name(position: float, rotation_deg: float) -> str:
    """The name of a limit in tables and figures."""
    return f"{position:g}; {rotation_deg:g} deg"


def summary(rows: Sequence[SubsetRow]) -> Summary:
    """The figures of several subsets together.

    The share of nights within a limit is that of all nights with a reference pose, registered or
    not. It is None if no night has a reference pose.
    """
    judged = [
        (row["position"], row["rotation_deg"])
        for row in rows
        if "position" in row and "rotation_deg" in row
    ]
    matches = [row["matches"] for row in rows if "matches" in row]
    correct = [row["correct"] for row in rows if "correct" in row]
    known = sum(row["has_truth"] for row in rows)
    within = {
        limit_name(d, deg): sum(p <= d and r <= deg for p, r in judged) / known
        for d, deg in LIMITS
        if known
    }
    return {
        "nights": len(rows),
        "night_registered": sum(row["registered"] for row in rows),
        "day_images": sum(row["day_images"] for row in rows),
        "day_registered": sum(row["day_registered"] for row in rows),
        "matches": sum(matches) if matches else None,
        "correct": sum(correct) if correct else None,
        "nights_with_reference": known,
        "within": within or None,
        "not_evaluated": sum("not_evaluated" in row for row in rows),
        "sorted_positions": sorted(position for position, _ in judged),
        "sorted_rotations_deg": sorted(rotation for _, rotation in judged),
    }
