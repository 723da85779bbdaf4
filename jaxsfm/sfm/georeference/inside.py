"""Measured positions inside a last adjustment of a model, so that a long row does not bend.

A move as a whole leaves a model its shape. Errors of keypoints add up along a row of photos, and
bend it, which no pixel shows; positions show it. So they take part in one more adjustment, each
weighed by its deviation, as keypoints are by theirs. How far a position is off is not believed from
its file: it is what positions miss that were left out. If those left out fit no better than after
the move alone, the model stays as it is.
"""

import dataclasses
import logging
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import stats

from jaxsfm.colmap.adjustment import adjustable
from jaxsfm.colmap.bundle_adjustment import adjusted_onto, write_into
from jaxsfm.colmap.given_model import has_rigs
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.core.bundle_problem import Positions
from jaxsfm.sfm.georeference.model_georeference import (
    AdjustedPositions,
    ModelGeoreference,
    NamedAnchors,
    expected_of,
    on_line,
    rms_of,
    vector,
)
from jaxsfm.sfm.georeference.robust_similarity import CERTAIN, EXACT, Anchors, robust_similarity

if TYPE_CHECKING:
    import pycolmap

FOLDS = 5
"""Positions are left out in so many groups. Each group is a stretch of photos in the order of their
names, because the errors of photos that were taken together are alike: a left out position between
two neighbours would be hit by a model that bends with their common error."""
LEAST_INSIDE = 10
"""With fewer positions, a group has one, and says next to nothing."""
FARTHEST = float(np.sqrt(stats.chi2.ppf(CERTAIN, 3)))
"""The scale of the robust loss of positions, in deviations: chance moves a right one farther with
the probability by which positions are called wrong."""
MIDDLE = float(stats.chi2.median(3))
"""The median square of an error in space, in squared deviations of each coordinate."""


logger = logging.getLogger("jaxsfm")


class Settings(NamedTuple):
    """How the last adjustment works."""

    loss_px: float
    """The scale of the loss of keypoints, original pixels."""
    refine_intrinsics: bool


def positions_inside(
    reconstruction: "pycolmap.Reconstruction",
    given: NamedAnchors,
    figures: ModelGeoreference,
    settings: Settings,
) -> ModelGeoreference:
    """Adjust a model that was moved into metres, in place, with the positions of its photos.

    Args:
      given: the positions, by the names of photos.
      figures: of the move.

    Returns:
      the figures of the adjusted model; those given if it stays as it is, which they say.
    """
    refines = settings.refine_intrinsics
    if (count := len(given.names)) < LEAST_INSIDE:
        return _only_moved(figures, f"{count} positions are too few (needed: {LEAST_INSIDE})")
    if has_rigs(reconstruction):
        return _only_moved(figures, "the model has rigs")
    model = Model.from_colmap(reconstruction, stored_sizes(reconstruction))
    if not adjustable(model, refine_intrinsics=refines):
        return _only_moved(figures, "the model is too large, or its cameras are of another kind")
    fitting = _Fitting(model, given, settings, noise_px(model, settings.loss_px, refines))
    anchors = fitting.anchors(model)
    if any(on_line(anchors.select(others)) for others in fitting.folds()):
        return _only_moved(figures, "the positions are on one line")
    alone = fitting.left_out_of_moves()
    deviation = spread_of(alone, given.anchors.deviation)
    if deviation * given.anchors.deviation.max() < EXACT * np.ptp(anchors.target, axis=0).max():
        return _only_moved(figures, "the positions fit exactly")
    inside = fitting.left_out_of_adjustments(deviation)
    scale = FARTHEST * deviation * given.anchors.deviation
    worth = [np.log1p((each**2).sum(1) / scale**2).sum() for each in (alone, inside)]
    used: np.ndarray = np.asarray([row.used for row in figures.anchors], bool)
    found = AdjustedPositions(
        kept=bool(worth[1] < worth[0]),
        moved_only=rms_of(alone[used]),
        adjusted=rms_of(inside[used]),
        noise_px=fitting.noise_px,
        deviation=deviation * float(np.median(given.anchors.deviation)),
    )
    if not found.kept:
        return dataclasses.replace(figures, inside=found)
    deviation = spread_of(inside, given.anchors.deviation)
    after = fitting.adjusted(deviation, np.ones(len(given.names), bool))
    write_into(after, reconstruction)
    return _figures(fitting, after, (figures, found), inside, deviation)


def _only_moved(figures: ModelGeoreference, why: str) -> ModelGeoreference:
    """The figures as they are; says why positions take no part in an adjustment."""
    logger.warning("positions do not take part in an adjustment: %s", why)
    return figures


def noise_px(model: Model, loss_px: float, refine_intrinsics: bool) -> float:
    """The deviation of a coordinate of a keypoint, original pixels, from the errors of a model that
    was adjusted: each unknown has taken up one of them."""
    errors = model.errors_px()
    errors, count = errors[np.isfinite(errors)], len(model.cameras)
    unknown = 6 * len(model.views) + 3 * len(model.tracks.points) + 4 * count * refine_intrinsics
    squared = errors**2 / (1 + (errors / loss_px) ** 2)
    return float(np.sqrt(squared.sum() / max(2 * len(errors) - unknown, 1)))


def spread_of(residuals: np.ndarray, deviation: np.ndarray) -> float:
    """The deviation of a coordinate of residuals float64 (n, 3), each in units of its own. The
    median is taken, so that wrong positions do not count."""
    return float(np.sqrt(np.median((residuals**2).sum(1) / deviation**2) / MIDDLE))


class _Fitting(NamedTuple):
    """A model, and the positions that it is adjusted with."""

    model: Model
    given: NamedAnchors
    settings: Settings
    noise_px: float

    def folds(self) -> list[np.ndarray]:
        """For each group of positions, bool (n,): those that are not in it."""
        parts = np.array_split(np.arange(len(self.given.names)), FOLDS)
        return [~np.isin(np.arange(len(self.given.names)), part) for part in parts]

    def left_out_of_moves(self) -> np.ndarray:
        """float64 (n, 3): residuals of the positions, each after a move onto other groups."""
        anchors, found = self.anchors(self.model), np.zeros((len(self.given.names), 3))
        for others in self.folds():
            similarity, _ = robust_similarity(anchors.select(others))
            found[~others] = anchors.select(~others).residuals(similarity)
        return found

    def left_out_of_adjustments(self, deviation: float) -> np.ndarray:
        """float64 (n, 3): residuals of the positions, each after an adjustment with other groups.

        Args:
          deviation: of a coordinate, in units of those of the anchors.
        """
        found = np.zeros((len(self.given.names), 3))
        for others in self.folds():
            found[~others] = self.residuals(self.adjusted(deviation, others))[~others]
        return found

    def adjusted(self, deviation: float, use: np.ndarray) -> Model:
        """The model, adjusted with some of the positions."""
        places = {view.name: k for k, view in enumerate(self.model.views)}
        rows = [places[name] for name in self.given.names]
        xyz, weight = np.zeros((len(places), 3)), np.zeros(len(places))
        xyz[rows] = self.given.anchors.target
        weight[rows] = use * (self.noise_px / (deviation * self.given.anchors.deviation)) ** 2
        positions = Positions(xyz, weight, np.float64(FARTHEST * self.noise_px))  # pyright: ignore
        return adjusted_onto(self.model, positions, **self.settings._asdict())

    def anchors(self, model: Model) -> Anchors:
        """The anchors as a model has them."""
        centres = {view.name: view.centre for view in model.views}
        return self.given.anchors._replace(source=np.stack([centres[n] for n in self.given.names]))

    def residuals(self, model: Model) -> np.ndarray:
        """float64 (n, 3): where a model in metres has the photos, minus where they were."""
        anchors = self.anchors(model)
        return anchors.source - anchors.target


def _figures(
    fitting: _Fitting,
    after: Model,
    before: tuple[ModelGeoreference, AdjustedPositions],
    held_out: np.ndarray,
    deviation: float,
) -> ModelGeoreference:
    """The figures of an adjusted model."""
    figures, found = before
    residuals, n = fitting.residuals(after), len(held_out)
    squared = (residuals**2).sum(1) / (deviation * fitting.given.anchors.deviation) ** 2 / 3
    used = squared < stats.f.ppf(CERTAIN, 3, 3 * n - 7)
    rows = [
        dataclasses.replace(row, used=bool(own), residual=vector(now), held_out=vector(out))
        for row, own, now, out in zip(figures.anchors, used, residuals, held_out, strict=True)
    ]
    return dataclasses.replace(
        figures,
        anchors=rows,
        residual=rms_of(residuals[used]),
        held_out=rms_of(held_out[used]),
        expected=expected_of(fitting.anchors(after).select(used)),
        inside=found,
    )
