"""Multi-view refinement of keypoints, in passes after mapping.

In a pass, every observation of a track is moved onto one reference patch. Views into which the
point projects, and that agree with the patch, get new observations; observations that do not agree
are dropped. Bundle adjustment and filtering follow.

The reference keypoint stays where it is, because it defines the point. So the spread of relocalized
keypoints over the views (1-2 px) goes, and a track reaches every view that shows its surface. Views
that show too little to be aligned in this way are placed at the end, on the structure of the others
(`jaxsfm.sfm.refine.weak_views`).
"""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.model import Model, Sizes
from jaxsfm.colmap.tracks import Observations, Tracks
from jaxsfm.config import Refinement
from jaxsfm.io.images import ImageError
from jaxsfm.io.photos import Reader
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.evidence import NO_EVIDENCE, Evidence
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits
from jaxsfm.sfm.refine.track_alignment import AlignedBlock, align_blocks
from jaxsfm.sfm.refine.weak_views import Placement, place_weak_views, remove_unconfirmed

if TYPE_CHECKING:
    import pycolmap

MIN_POINTS = 10
"""A model with fewer points is not refined."""
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
    points: int
    """After the pass."""
    reprojection_error_px: float
    """Mean over the points, original pixels."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefinementFigures:
    """The result of the refinement of a model."""

    passes: list[PassFigures]
    placed: list[Placement]
    """One for each view that was weak in any pass, and for each image that the mapper left out."""


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


def _working_sizes(
    reconstruction: "pycolmap.Reconstruction", read: Reader, evidence: Evidence
) -> tuple[Sizes, Evidence]:
    """The sizes of all images, and the evidence without unmapped images that cannot be read."""

    def working_size(name: str) -> tuple[tuple[int, int], tuple[float, float]]:
        gray, scale = read(name)
        return (gray.shape[1], gray.shape[0]), scale

    sizes = {}
    for image_id in sorted(reconstruction.reg_image_ids()):
        name = reconstruction.image(image_id).name
        sizes[name] = working_size(name)
    readable = []
    for image in evidence.unmapped:
        with contextlib.suppress(ImageError):  # deleted since; it is not in the model anyway
            sizes[image.name] = working_size(image.name)
            readable.append(image)
    return sizes, evidence._replace(unmapped=readable)


def refine_model(
    reconstruction: "pycolmap.Reconstruction",
    read: Reader,
    *,
    refinement: Refinement,
    refine_intrinsics: bool,
    evidence: Evidence = NO_EVIDENCE,
    threads: int = -1,
    on_pass: Callable[[], None] = lambda: None,
) -> "tuple[pycolmap.Reconstruction, RefinementFigures]":
    """Refine a model.

    Thresholds are in pixels of the working images. An image where too little agrees keeps its old
    observations, with four times the error limit, until it is placed on the refined structure. One
    that cannot be placed and has hardly any observations is taken out. A pass that would lose most
    of the points is taken back.

    Args:
      reconstruction: from the mapper; not changed.
      read: intensities by image name; may be called several times per image.
      refine_intrinsics: whether bundle adjustment moves focal lengths and distortion.
      evidence: images that the mapper left out, and matches to place them and weak views by.
      threads: of bundle adjustment. With one thread the model is repeatable to the last byte.

    Raises:
      ImageError: an image of the model cannot be read any more.
    """
    sizes, evidence = _working_sizes(reconstruction, read, evidence)
    model = Model.from_colmap(reconstruction, sizes)
    images = DeviceImages(read)
    figures: list[PassFigures] = []
    limits = AlignmentLimits.of(refinement)
    for number in range(refinement.passes):
        if len(model.tracks.points) < MIN_POINTS or len(model.views) < 2:
            break
        if number == 1:
            limits = limits._replace(max_shift_px=limits.max_shift_px / 2)
        blocks = list(align_blocks(model, images, refinement, limits))
        aligned, weak = _gather(model, blocks)
        weak_names = sorted(model.views[k].name for k in weak)
        adjusted = _adjust(aligned, weak, sizes, refinement, refine_intrinsics, threads)
        enough = max(MIN_POINTS, MIN_POINT_SHARE * len(model.tracks.points))
        accepted = adjusted is not None and adjusted[0].num_points3D() >= enough
        if adjusted is not None and accepted:
            reconstruction, model = adjusted
        agrees = np.concatenate([block.agrees for block in blocks])
        tracked = np.concatenate([block.tracked for block in blocks])
        figures.append(
            PassFigures(
                accepted=accepted,
                candidates=len(agrees),
                kept=int((agrees & tracked).sum()),
                dropped=int((~agrees & tracked).sum()),
                added=int((agrees & ~tracked).sum()),
                weak_views=weak_names,
                points=reconstruction.num_points3D(),
                reprojection_error_px=reconstruction.compute_mean_reprojection_error(),
            )
        )
        on_pass()
        if not accepted:
            break
    placed: list[Placement] = []
    # A view that was weak in any pass is placed: what little agreed in the first pass looks like
    # much in the next (58 of 153 observations after 22 of 393, and the camera 0.4 m off).
    weak_names = sorted({name for f in figures if f.accepted for name in f.weak_views})
    if any(f.accepted for f in figures) and (weak_names or evidence.unmapped):
        before = model
        model, placed = place_weak_views(
            model,
            weak_names,
            images,
            sizes,
            refinement=refinement,
            refine_intrinsics=refine_intrinsics,
            evidence=evidence,
        )
        if model is not before:
            reconstruction = model.to_colmap()
        if refinement.weak_octaves:  # otherwise nothing has tried to confirm their poses
            if model is not before:  # COLMAP left out points whose rays are too close
                model = Model.from_colmap(reconstruction, sizes)
            before = model
            model, placed = remove_unconfirmed(model, placed)
            if model is not before:
                reconstruction = model.to_colmap()
    return reconstruction, RefinementFigures(passes=figures, placed=placed)


def _adjust(
    model: Model,
    weak: np.ndarray,
    sizes: Sizes,
    refinement: Refinement,
    refine_intrinsics: bool,
    threads: int,
) -> "tuple[pycolmap.Reconstruction, Model] | None":
    """Filter the observations and adjust the bundle, twice; None if (nearly) nothing is left.

    Args:
      weak: views whose observations were not aligned; they may have four times the error.
    """
    loss_px = float(np.median([view.mean_scale for view in model.views]))
    weak_view = np.isin(np.arange(len(model.views)), weak)
    limit = refinement.max_error_px * np.where(weak_view, 4.0, 1.0)
    adjusted = None
    # The first filter is coarse: a point far behind or beside its plane makes the solver fail.
    for slack in (4.0, 1.0):
        good = model.errors_px() < slack * limit[model.tracks.view]
        reconstruction = model.select(good).to_colmap()
        if reconstruction.num_points3D() < MIN_POINTS:
            return None
        bundle_adjust(
            reconstruction,
            loss_px=loss_px,
            refine_intrinsics=refine_intrinsics,
            threads=threads,
        )
        model = Model.from_colmap(reconstruction, sizes)
        adjusted = reconstruction, model
    return adjusted
