"""One pass of the refinement: observations are aligned, and the bundle is adjusted."""

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.colmap.bundle_adjustment import adjusted
from jaxsfm.colmap.mapper import MIN_MODEL_POINTS
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Observations, Tracks
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits
from jaxsfm.sfm.refine.track_alignment import AlignedBlock, align_blocks

if TYPE_CHECKING:
    import pycolmap

MIN_POINT_SHARE = 0.25
"""A pass that keeps less of the points is taken back: the images do not agree well enough."""
WEAK_COUNT, WEAK_SHARE = 30, 0.25
"""A view is weak if fewer of its observations agree (in number, or as a share of those it had). It
keeps its old observations in the pass: otherwise a night photo would hang on a handful."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PassFigures:
    """The result of one pass."""

    accepted: bool
    """False: too little agreed, and the model before the pass stays."""
    candidates: int
    kept: int
    """Observations of the tracks before the pass that agreed with their reference patch."""
    dropped: int
    added: int
    weak_views: list[str]
    """Images that kept their old observations in this pass, because too few agreed."""
    doubtful_views: list[str] = dataclasses.field(default_factory=list)
    """Images in which a much smaller share of the candidates agreed than in others."""
    points: int
    """After the pass."""
    reprojection_error_px: float
    """Mean over the points, original pixels."""
    shift_px: float | None = None
    """How far the observations that agreed were moved, the mean in original pixels. The reference
    keypoints of the points, which stay where they are, do not count. None: there are none, or an
    earlier version did not measure it."""


DOUBTFUL_SHARE = 1 / 3
"""A view is doubtful if the share of its candidates that agree is smaller than this part of the
median view's share. One whose pose was 4.8 deg off, on entry-P10, had 0.18 of it; views with right
poses had 0.41 and more, on the Strecha sets and on Sacre Coeur."""


class PassSettings(NamedTuple):
    """How a pass is done."""

    refinement: Refinement
    refine_intrinsics: bool
    """Whether bundle adjustment moves focal lengths and distortion."""
    threads: int
    """Of bundle adjustment."""
    held: tuple[int, ...] = ()
    """Cameras that stay where they are on their rig (`jaxsfm.colmap.bundle_adjustment`)."""


class Refined(NamedTuple):
    """A model, as COLMAP's and as arrays."""

    reconstruction: "pycolmap.Reconstruction"
    model: Model


def run_pass(
    before: Refined,
    images: DeviceImages,
    px: int,
    limits: AlignmentLimits,
    settings: PassSettings,
) -> tuple[Refined, PassFigures]:
    """Align the observations of a model and adjust it.

    Args:
      images: those of its views.
      px: the size of a pixel in this pass, working pixels.
      limits: what an aligned keypoint must fulfil to count, in pixels of this pass.

    Returns:
      the model after the pass, which is the one before if too little agreed; what was done.

    Raises:
      ImageError: an image of the model cannot be read any more.
    """
    start = before.model.in_octave(px)
    blocks = list(align_blocks(start, images.octave(px), settings.refinement, limits))
    aligned, weak = _gather(start, blocks)
    adjusted = _adjust(aligned, weak, settings)
    if adjusted is not None and px > 1:
        model = Model.from_colmap(adjusted.reconstruction, before.model.sizes)
        adjusted = adjusted._replace(model=model)
    enough = max(MIN_MODEL_POINTS, MIN_POINT_SHARE * len(before.model.tracks.points))
    accepted = adjusted is not None and adjusted.reconstruction.num_points3D() >= enough
    after = adjusted if adjusted is not None and accepted else before
    agrees = np.concatenate([block.agrees for block in blocks])
    tracked = np.concatenate([block.tracked for block in blocks])
    return after, PassFigures(
        accepted=accepted,
        candidates=len(agrees),
        kept=int((agrees & tracked).sum()),
        dropped=int((~agrees & tracked).sum()),
        added=int((agrees & ~tracked).sum()),
        weak_views=sorted(before.model.views[k].name for k in weak),
        doubtful_views=sorted(view.name for view in _doubtful(before.model.views, blocks)),
        points=after.reconstruction.num_points3D(),
        reprojection_error_px=after.reconstruction.compute_mean_reprojection_error(),
        shift_px=_mean_shift(start.views, blocks),
    )


def _mean_shift(views: Sequence[View], blocks: Sequence[AlignedBlock]) -> float | None:
    """How far the observations that agree were moved, the mean in original pixels."""
    scale = np.asarray([view.pixels.scale for view in views])
    shifts = [np.zeros(0)]
    for block in blocks:
        rows = np.flatnonzero(block.agrees & block.tracked)
        moved = (block.moved[rows] - block.before[rows]) * scale[block.found.view[rows]]
        shifts.append(np.linalg.norm(moved, axis=1))
    every = np.concatenate(shifts)
    # The sum is exact, so that it does not depend on the blocks.
    return math.fsum(every) / len(every) if len(every) else None


def _doubtful(views: Sequence[View], blocks: Sequence[AlignedBlock]) -> list[View]:
    """The views in which a much smaller share of the candidates agreed than in others."""
    count = len(views)
    # Where pixels are not used there is no score, and nothing to agree with.
    shown = sum(
        np.bincount(block.found.view[np.isfinite(block.score)], minlength=count) for block in blocks
    )
    agreed = sum(np.bincount(block.found.view[block.agrees], minlength=count) for block in blocks)
    share = np.asarray(agreed / np.maximum(shown, 1))
    return [views[k] for k in np.flatnonzero(share < DOUBTFUL_SHARE * np.median(share)).tolist()]


def _gather(model: Model, blocks: Sequence[AlignedBlock]) -> tuple[Model, np.ndarray]:
    """The model with its new tracks, and the indices of the weak views."""
    tracks, count = model.tracks, len(model.views)
    had = np.bincount(tracks.view, minlength=count)
    agreed = np.zeros(count, int)
    points = tracks.points.copy()
    parts: list[Observations] = []
    alive = np.zeros(len(points), bool)
    for block in blocks:
        points[block.rows] = block.patches.points
        own = block.confirmed
        alive[block.rows[own]] = True
        parts += block.observations()
        agreed += np.bincount(block.found.view[block.agrees & block.tracked], minlength=count)
        agreed += np.bincount(block.patches.reference[own], minlength=count)
    weak = np.flatnonzero(agreed < np.maximum(np.minimum(WEAK_COUNT, had), WEAK_SHARE * had))
    # Weak views keep old observations of points that remain, where no new one took their place.
    old = np.flatnonzero(np.isin(tracks.view, weak) & alive[tracks.point])
    taken = np.concatenate([part.point * count + part.view for part in parts])
    old = old[~np.isin(tracks.point[old] * count + tracks.view[old], taken)]
    parts.append(tracks.select(old).observations)
    return model.with_tracks(Tracks.from_parts(points, parts, ordered=True)), weak


def _adjust(model: Model, weak: np.ndarray, settings: PassSettings) -> Refined | None:
    """Filter the observations and adjust the bundle, twice; None if (nearly) nothing is left.

    Args:
      weak: views whose observations were not aligned; they may have four times the error.
    """
    loss_px = float(np.median([view.mean_scale for view in model.views]))
    weak_view = np.isin(np.arange(len(model.views)), weak)
    limit = settings.refinement.max_error_px * np.where(weak_view, 4.0, 1.0)
    # The first filter is coarse: a point far behind or beside its plane draws its views with it.
    for slack in (4.0, 1.0):
        good = model.errors_px() < slack * limit[model.tracks.view]
        model = model.select(good).triangulated()
        if len(model.tracks.points) < MIN_MODEL_POINTS:
            return None
        model = adjusted(
            model,
            loss_px=loss_px,
            refine_intrinsics=settings.refine_intrinsics,
            threads=settings.threads,
            held=settings.held,
        )
    reconstruction = model.to_colmap()
    reconstruction.update_point_3d_errors()
    return Refined(reconstruction, Model.from_colmap(reconstruction, model.sizes))
