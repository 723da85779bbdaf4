"""How a model was moved into metres, and how well the measured positions agree with it."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from jaxsfm.sfm.evaluation import COLLINEAR, Similarity
from jaxsfm.sfm.georeference.robust_similarity import (
    LEAST,
    Anchors,
    certainty,
    robust_similarity,
)

MAX_TURN_DEG = 10.0
"""A model whose direction is less certain is not moved unless the user asked for it."""
MAX_SCALE = 0.1
"""Likewise for its scale, as a share."""
SAME = Similarity(1.0, np.eye(3), np.zeros(3))
"""Of a model that is in metres already."""
Vector = tuple[float, float, float]
"""East, north and up, or x, y and z."""


@dataclass(frozen=True, kw_only=True)
class AnchorRow:
    """A measured position, and where the moved model has it."""

    name: str
    """Of the photo or of the control point."""
    used: bool
    """Whether it took part in the move. Otherwise it disagrees with the others."""
    residual: Vector
    """The model's position minus the measured one, metres."""
    held_out: Vector | None
    """The same after a move without this one; None if the others do not determine the move."""
    deviation: float | None = None
    """The expected horizontal error that came with the position, metres."""
    errors_px: dict[str, float] = field(default_factory=dict)
    """Of a control point: the error of its measurement in each photo, original pixels."""


@dataclass(frozen=True, kw_only=True)
class Rms:
    """Root mean squares of errors, metres."""

    east: float
    north: float
    up: float
    horizontal: float
    """Of the distances in the horizontal plane."""
    total: float
    """Of the distances in space."""


@dataclass(frozen=True, kw_only=True)
class Expected:
    """Expected deviations (one sigma) of the move, if the errors of positions are independent."""

    shift: Vector
    """Of the middle of the positions, metres."""
    turn_deg: float
    """About the axis that is the least certain, degrees."""
    scale: float
    """As a share of the scale."""


@dataclass(frozen=True, kw_only=True)
class AppliedSimilarity:
    """The map x -> scale * rotation @ x + translation, from the frame of the mapper."""

    scale: float
    """Metres for each unit of the mapper."""
    rotation: tuple[Vector, Vector, Vector]
    """The rows of the matrix."""
    translation: Vector


@dataclass(frozen=True, kw_only=True)
class AdjustedPositions:
    """What positions inside an adjustment are worth (`jaxsfm.sfm.georeference.inside`)."""

    kept: bool
    """Whether the model is the adjusted one: positions that were left out fit it better."""
    moved_only: Rms
    """Of the positions that took part in the move, each after a move without its group."""
    adjusted: Rms
    """Of the same, each after an adjustment without its group."""
    noise_px: float
    """The deviation of a coordinate of a keypoint, original pixels."""
    deviation: float
    """The deviation of a coordinate of a usual position, as the adjustment weighed it, metres."""


@dataclass(frozen=True, kw_only=True)
class ModelGeoreference:
    """How one model was moved."""

    similarity: AppliedSimilarity | None
    """None: the model stays in the frame of the mapper."""
    why_not: str | None = None
    """Why the model was not moved, in words."""
    contradicted: bool = False
    """Whether it was not moved because the photos contradict the positions of a file."""
    upside_down: bool = False
    """Whether most cameras hang upside down after the move."""
    anchors: list[AnchorRow] = field(default_factory=list)
    """Sorted by name."""
    unused: dict[str, str] = field(default_factory=dict)
    """Why a position could not take part, by name."""
    residual: Rms | None = None
    """Of the positions that took part."""
    held_out: Rms | None = None
    """Of the same, each after a move without it, or an adjustment without its group."""
    expected: Expected | None = None
    inside: AdjustedPositions | None = None
    """None: positions did not take part in an adjustment."""

    @property
    def outliers(self) -> list[str]:
        """The names of the positions that disagree with the others."""
        return [row.name for row in self.anchors if not row.used]


class NamedAnchors(NamedTuple):
    """Anchors with what the report tells of them."""

    names: list[str]
    anchors: Anchors
    deviation: list[float | None]
    """The expected errors that came with the positions."""
    errors_px: list[dict[str, float]]
    unused: dict[str, str]


def georeferenced(
    given: NamedAnchors, what: str, *, sure: bool
) -> tuple[ModelGeoreference, Similarity | None]:
    """Find the move of a model onto measured positions.

    Args:
      what: what the anchors are, in words for the report: `photos with a GPS position`.
      sure: whether a move that is not certain (`MAX_TURN_DEG`, `MAX_SCALE`) is refused.

    Returns:
      the figures; the move, or None if the positions do not determine it.
    """
    anchors = given.anchors

    def refused(why: str) -> tuple[ModelGeoreference, None]:
        return ModelGeoreference(similarity=None, why_not=why, unused=given.unused), None

    if len(given.names) < LEAST:
        return refused(f"the model has {len(given.names)} {what}; at least {LEAST} are needed")
    if on_line(anchors):
        return refused(f"the {what} lie on one line, so the turn about this line is not known")
    similarity, used = robust_similarity(anchors)
    if not similarity.scale > 0 or on_line(anchors.select(used)):
        return refused(f"the {what} that agree with each other lie on one line or in one place")
    part = anchors.select(used)
    sigma = certainty(part, similarity)
    if sure and not (sigma.turn_deg <= MAX_TURN_DEG and sigma.scale <= MAX_SCALE):
        return refused(
            f"the {what} leave its direction uncertain by {sigma.turn_deg:.0f} degrees and its "
            f"scale by {100 * sigma.scale:.0f} %, because they are near each other or near one "
            "line; --georeference gps moves it all the same"
        )
    residuals = anchors.residuals(similarity)
    held_out = _held_out(anchors, used, residuals)
    rows = [
        AnchorRow(
            name=name,
            used=bool(used[k]),
            residual=vector(residuals[k]),
            held_out=None if held_out is None else vector(held_out[k]),
            deviation=given.deviation[k],
            errors_px=given.errors_px[k],
        )
        for k, name in enumerate(given.names)
    ]
    found = ModelGeoreference(
        similarity=AppliedSimilarity(
            scale=similarity.scale,
            rotation=(
                vector(similarity.rotation[0]),
                vector(similarity.rotation[1]),
                vector(similarity.rotation[2]),
            ),
            translation=vector(similarity.translation),
        ),
        anchors=rows,
        unused=given.unused,
        residual=rms_of(residuals[used]),
        held_out=None if held_out is None else rms_of(held_out[used]),
        expected=expected_of(part, similarity),
    )
    return found, similarity


def expected_of(anchors: Anchors, similarity: Similarity = SAME) -> Expected:
    """How certain the place of a model is that was moved onto anchors, or adjusted with them."""
    sigma = certainty(anchors, similarity)
    return Expected(shift=vector(sigma.shift), turn_deg=sigma.turn_deg, scale=sigma.scale)


def contradicted(figures: ModelGeoreference, why: str) -> ModelGeoreference:
    """The figures of a model that is not moved, because the photos contradict the positions."""
    return ModelGeoreference(similarity=None, why_not=why, contradicted=True, unused=figures.unused)


def on_line(anchors: Anchors) -> bool:
    """Whether either side of the anchors lies on one line, or in one place."""
    for points in (anchors.source, anchors.target):
        spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if spread[0] == 0 or spread[1] < COLLINEAR * spread[0]:
            return True
    return False


def _held_out(anchors: Anchors, used: np.ndarray, residuals: np.ndarray) -> np.ndarray | None:
    """float64 (n, 3): the residual of each anchor after a fit to the used ones but this one.

    None if the others are too few, or lie on one line for any of them.
    """
    if int(used.sum()) <= LEAST:
        return None
    held_out = residuals.copy()  # an anchor that was not used is held out as it is
    for k in np.flatnonzero(used):
        others = used.copy()
        others[k] = False
        part = anchors.select(others)
        if on_line(part):
            return None
        held_out[k] = anchors.select(np.asarray([k])).residuals(part.fit())[0]
    return held_out


def vector(values: np.ndarray) -> Vector:
    """Three numbers of an array."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def rms_of(errors: np.ndarray) -> Rms:
    """The root mean squares of errors float64 (n, 3)."""
    east, north, up = (float(value) for value in (errors**2).mean(0))
    return Rms(
        east=east**0.5,
        north=north**0.5,
        up=up**0.5,
        horizontal=(east + north) ** 0.5,
        total=(east + north + up) ** 0.5,
    )
