"""Multi-view keypoint refinement: after mapping, every track's observations are moved onto one
reference patch, new observations are added where the point projects into a view that agrees, what
does not agree is dropped, then bundle adjustment and filtering; repeated.

The reference keypoint stays where it is: it *is* the point. So relocalization's spread over views
(1-2 px) goes, and tracks reach across every view that shows the surface. Views that show too little
to be aligned so are placed at the end, on the structure of the others
(`jaxsfm.sfm.refine.weak_views`).
"""

import contextlib
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from jaxsfm.colmap.model import (
    Sizes,
    Tracks,
    View,
    build_model,
    bundle_adjust,
    errors_px,
    read_model_arrays,
    select,
)
from jaxsfm.config import Refinement
from jaxsfm.io.images import ImageError
from jaxsfm.io.photos import Reader
from jaxsfm.sfm.refine.track_alignment import AlignedBlock, align_blocks
from jaxsfm.sfm.refine.weak_views import (
    NO_EVIDENCE,
    Evidence,
    Placement,
    place_weak_views,
    take_out,
)

if TYPE_CHECKING:
    import pycolmap

MIN_POINTS = 10
"""A model with fewer points is left alone."""
MIN_POINT_SHARE = 0.25
"""A pass that loses more of the points is taken back: the images do not agree well enough."""
WEAK_COUNT, WEAK_SHARE = 30, 0.25
"""A view where fewer of its observations agree (in number, or of those it had) keeps the old ones:
a night photo would else hang on a handful."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PassFigures:
    """What one pass did."""

    accepted: bool
    """False: too little agreed; the model before the pass stays."""
    candidates: int
    kept: int
    """Observations of the tracks before the pass that agreed with their reference."""
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
    """What the refinement of a model did."""

    passes: list[PassFigures]
    placed: list[Placement]
    """The weak views of any pass, and images that the mapper left out."""


def _gather(
    tracks: Tracks, views: list[View], blocks: list[AlignedBlock]
) -> tuple[Tracks, np.ndarray]:
    """The new tracks, and the weak views."""
    had = np.bincount(tracks.view, minlength=len(views))
    agreed = np.zeros(len(views), int)
    points = tracks.points.copy()
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    alive = np.zeros(len(points), bool)
    for b in blocks:
        points[b.rows] = b.points
        good = np.flatnonzero(b.agrees)
        own = np.unique(b.found.point[good])
        alive[b.rows[own]] = True
        parts.append((b.rows[own], b.reference[own], b.xy[own]))
        parts.append((b.rows[b.found.point[good]], b.found.view[good], b.moved[good]))
        kept = good[b.tracked[good]]
        agreed += np.bincount(b.found.view[kept], minlength=len(views))
        agreed += np.bincount(b.reference[own], minlength=len(views))
    weak = np.flatnonzero(agreed < np.maximum(np.minimum(WEAK_COUNT, had), WEAK_SHARE * had))
    point, view, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    # Old observations of weak views, of points that live on, where nothing new took their place.
    old = np.flatnonzero(np.isin(tracks.view, weak) & alive[tracks.point])
    taken = np.isin(tracks.point[old] * len(views) + tracks.view[old], point * len(views) + view)
    old = old[~taken]
    point = np.concatenate([point, tracks.point[old]])
    view = np.concatenate([view, tracks.view[old]])
    xy = np.concatenate([xy, tracks.xy[old]])
    order = np.lexsort((view, point))  # whatever the blocks: sums round the same way
    return Tracks(points, point[order], view[order], xy[order]), weak


def _size(read: Reader, name: str) -> tuple[tuple[int, int], tuple[float, float]]:
    gray, scale = read(name)
    return (gray.shape[1], gray.shape[0]), scale


def refine_model(
    model: "pycolmap.Reconstruction",
    read: Reader,
    *,
    config: Refinement,
    refine_intrinsics: bool,
    evidence: Evidence = NO_EVIDENCE,
    threads: int = -1,
    on_pass: Callable[[], None] = lambda: None,
) -> "tuple[pycolmap.Reconstruction, RefinementFigures]":
    """A refined model, and what was done.

    Thresholds are in pixels of the working images. An image where too little agrees keeps its old
    observations, at four times the error limit, until it is placed on the refined structure; one
    that cannot be placed and that hardly any observations hold is taken out. A pass that would
    lose most of the points is taken back.

    Args:
      model: from the mapper; not changed.
      read: intensities by image name; called several times per image and pass.
      refine_intrinsics: whether bundle adjustment moves focal lengths and distortion.
      evidence: images that the mapper left out, and matches to place them and weak views by.
      threads: of bundle adjustment; one makes the model repeatable to the last byte.

    Raises:
      ImageError: an image cannot be read any more.
    """
    sizes = {}
    for image_id in sorted(model.reg_image_ids()):
        name = model.image(image_id).name
        sizes[name] = _size(read, name)
    readable = []
    for image in evidence.left_out:
        with contextlib.suppress(ImageError):  # it went away since, and is not in the model anyway
            sizes[image.name] = _size(read, image.name)
            readable.append(image)
    evidence = evidence._replace(left_out=readable)
    figures: list[PassFigures] = []
    for number in range(config.passes):
        views, tracks = read_model_arrays(model, sizes)
        if len(tracks.points) < MIN_POINTS or len(views) < 2:
            break
        max_shift = config.max_shift_px / (1 if number == 0 else 2)
        blocks = list(align_blocks(tracks, views, read, config, max_shift))
        refined, weak = _gather(tracks, views, blocks)
        fresh = _adjust(model, views, refined, weak, sizes, config, refine_intrinsics, threads)
        enough = max(MIN_POINTS, MIN_POINT_SHARE * len(tracks.points))
        accepted = fresh is not None and fresh.num_points3D() >= enough
        if fresh is not None and accepted:
            model = fresh
        agrees = np.concatenate([b.agrees for b in blocks])
        tracked = np.concatenate([b.tracked for b in blocks])
        figures.append(
            PassFigures(
                accepted=accepted,
                candidates=len(agrees),
                kept=int((agrees & tracked).sum()),
                dropped=int((~agrees & tracked).sum()),
                added=int((agrees & ~tracked).sum()),
                weak_views=sorted(views[k].name for k in weak),
                points=model.num_points3D(),
                reprojection_error_px=model.compute_mean_reprojection_error(),
            )
        )
        on_pass()
        if not accepted:
            break
    placed: list[Placement] = []
    # Weak in one pass is weak: what little agreed looks like much in the next (58 of 153
    # observations after 22 of 393, and the camera 0.4 m off).
    weak_names = sorted({name for f in figures if f.accepted for name in f.weak_views})
    if any(f.accepted for f in figures) and (weak_names or evidence.left_out):
        model, placed = place_weak_views(
            model,
            weak_names,
            read,
            sizes,
            config=config,
            refine_intrinsics=refine_intrinsics,
            evidence=evidence,
        )
        if config.weak_octaves:  # else nobody has tried to confirm them
            model, placed = take_out(model, placed, sizes)
    return model, RefinementFigures(passes=figures, placed=placed)


def _adjust(
    template: "pycolmap.Reconstruction",
    views: list[View],
    tracks: Tracks,
    weak: np.ndarray,
    sizes: Sizes,
    config: Refinement,
    refine_intrinsics: bool,
    threads: int,
) -> "pycolmap.Reconstruction | None":
    """Filter and bundle adjustment, twice; None if (nearly) nothing is left.

    Args:
      weak: views whose observations were not aligned: they may have four times the error.
    """
    loss_px = float(np.median([view.scale.mean() for view in views]))
    limit = config.max_error_px * np.where(np.isin(np.arange(len(views)), weak), 4.0, 1.0)
    model = template
    # The first filter is coarse: a point far behind or beside its plane makes the solver fail.
    for slack in (4.0, 1.0):
        good = errors_px(views, tracks) < slack * limit[tracks.view]
        model = build_model(model, views, select(tracks, good))
        if model.num_points3D() < MIN_POINTS:
            return None
        bundle_adjust(model, loss_px=loss_px, refine_intrinsics=refine_intrinsics, threads=threads)
        views, tracks = read_model_arrays(model, sizes)
    return model
