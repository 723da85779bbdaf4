"""Multi-view keypoint refinement: after mapping, every track's observations are moved onto one
reference patch, new observations are added where the point projects into a view that agrees, what
does not agree is dropped, then bundle adjustment and filtering; repeated.

The reference keypoint stays where it is: it *is* the point. So relocalization's spread over views
(1-2 px) goes, and tracks reach across every view that shows the surface.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np

from jaxsfm import surface
from jaxsfm.config import Refinement
from jaxsfm.core import align as align_core
from jaxsfm.host import interrupt
from jaxsfm.host.model import (
    Tracks,
    View,
    build_model,
    bundle_adjust,
    errors_px,
    read_model_arrays,
    select,
)

if TYPE_CHECKING:
    import pycolmap

ReadGray = Callable[[str], tuple[np.ndarray, tuple[float, float]]]
"""Image name -> float32 (h, w) intensities of the working image, original pixels per pixel."""
CHUNK = 4096
"""Keypoints aligned by one call of the compiled program."""
CELLS = 10_000_000
"""Points times views looked at together; about 100 bytes each, and 2.7 kB for each point."""
MIN_BLOCK, MAX_BLOCK = 1000, 100_000
"""Points of a block, whatever the number of views."""
MIN_POINTS = 10
"""A model with fewer points is left alone."""
MIN_POINT_SHARE = 0.25
"""A pass that loses more of the points is taken back: the images do not agree well enough."""
WEAK_COUNT, WEAK_SHARE = 30, 0.25
"""A view where fewer of its observations agree (in number, or of those it had) keeps the old ones:
a night photo would else hang on a handful."""
PAD = 128
"""Maps are padded to multiples of this, so that few image sizes mean few compilations."""


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
    """Images that kept their old observations, because too few agreed."""
    points: int
    """After the pass."""
    reprojection_error_px: float
    """Mean over the points, original pixels."""


class _Block(NamedTuple):
    """The outcome of alignment for some of the points."""

    rows: np.ndarray
    """The points, indices."""
    points: np.ndarray
    """Where they lie now: on their reference rays."""
    reference: np.ndarray
    xy: np.ndarray
    """The reference keypoints."""
    found: surface.Candidates
    """Their `point` counts within the block."""
    moved: np.ndarray
    agrees: np.ndarray
    tracked: np.ndarray
    """Candidates that are observations of the old tracks."""


def _padded(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    h, w = image.shape
    wide = np.pad(image, ((0, -h % PAD), (0, -w % PAD)))
    return wide[..., None], np.asarray([h, w], np.int32)


def _chunks(rows: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    """Rows in pieces of CHUNK, the last one filled up with its first row, and how many count."""
    for start in range(0, len(rows), CHUNK):
        piece = rows[start : start + CHUNK]
        filled = np.full(CHUNK, piece[0])
        filled[: len(piece)] = piece
        interrupt.check()
        yield filled, len(piece)


def _templates(
    reference: np.ndarray,
    xy: np.ndarray,
    views: list[View],
    read: ReadGray,
    patch: align_core.Patch,
) -> align_core.Templates:
    """Templates of all points, one view's image in memory at a time."""
    n, q = len(reference), len(patch.weights)
    store = [
        np.zeros((n, q, 1), np.float32),
        np.zeros((n, q, 1, 2), np.float32),
        np.zeros((n, 2, 2), np.float32),
        np.zeros(n, np.float32),
        np.zeros(n, bool),
    ]
    for k in np.unique(reference):
        image, size = _padded(read(views[k].name)[0])
        for piece, count in _chunks(np.flatnonzero(reference == k)):
            made = align_core.make_templates(
                image,  # pyright: ignore[reportArgumentType]
                size,  # pyright: ignore[reportArgumentType]
                np.float32(xy[piece]),  # pyright: ignore[reportArgumentType]
                patch,
            )
            for held, new in zip(store, jax.device_get(made), strict=True):
                held[piece[:count]] = new[:count]
    return align_core.Templates(*store)  # pyright: ignore[reportArgumentType]


def _align(
    found: surface.Candidates,
    templates: align_core.Templates,
    views: list[View],
    read: ReadGray,
    patch: align_core.Patch,
    config: Refinement,
    max_shift_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Where the candidates end, and which agree with their templates."""
    moved = found.start.copy()
    agrees = np.zeros(len(moved), bool)
    for k in np.unique(found.view):
        image, size = _padded(read(views[k].name)[0])
        for piece, count in _chunks(np.flatnonzero(found.view == k)):
            result = jax.device_get(
                align_core.align(
                    image,  # pyright: ignore[reportArgumentType]
                    size,  # pyright: ignore[reportArgumentType]
                    jax.tree.map(lambda a, p=found.point[piece]: a[p], templates),
                    np.float32(found.start[piece]),  # pyright: ignore[reportArgumentType]
                    np.float32(found.affine[piece]),  # pyright: ignore[reportArgumentType]
                    patch,
                    iterations=config.iterations,
                )
            )
            shift = np.linalg.norm(result.xy - found.start[piece], axis=1)
            good = (
                result.converged
                & (result.score > config.min_score)
                & (result.sigma < config.max_sigma_px)
                & (shift < max_shift_px)
            )
            moved[piece[:count]] = result.xy[:count]
            agrees[piece[:count]] = good[:count]
    return moved, agrees


def _blocks(
    tracks: Tracks, views: list[View], read: ReadGray, config: Refinement, max_shift_px: float
) -> Iterator[_Block]:
    """Align every point's observations, so many points at a time that memory stays bounded."""
    normal = surface.normals(tracks, views, neighbours=config.neighbours)
    patch = align_core.square_patch(config.radius)
    step = max(MIN_BLOCK, min(CELLS // len(views), MAX_BLOCK))
    order = np.argsort(tracks.point, kind="stable")
    ends = np.searchsorted(tracks.point[order], np.arange(len(tracks.points) + 1))
    for first in range(0, len(tracks.points), step):
        rows = np.arange(first, min(first + step, len(tracks.points)))
        own = order[ends[first] : ends[rows[-1] + 1]]
        part = Tracks(
            tracks.points[rows], tracks.point[own] - first, tracks.view[own], tracks.xy[own]
        )
        seen = surface.visibility(part, views, normal[rows])
        reference = surface.reference_views(seen)
        xy = seen.xy[np.arange(len(rows)), reference]
        points = surface.on_reference_rays(part, views, normal[rows], reference, xy)
        found = surface.candidates(
            points,
            views,
            normal[rows],
            reference,
            xy,
            seen,
            margin=config.radius + 2,
            min_cosine=config.min_cosine,
            max_stretch=config.max_stretch,
        )
        templates = _templates(reference, xy, views, read, patch)
        moved, agrees = _align(found, templates, views, read, patch, config, max_shift_px)
        tracked = seen.tracked[found.point, found.view]
        yield _Block(rows, points, reference, xy, found, moved, agrees, tracked)


def _gather(tracks: Tracks, views: list[View], blocks: list[_Block]) -> tuple[Tracks, np.ndarray]:
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


def refine_model(
    model: "pycolmap.Reconstruction",
    read: ReadGray,
    *,
    config: Refinement,
    refine_intrinsics: bool,
    threads: int = -1,
    on_pass: Callable[[], None] = lambda: None,
) -> "tuple[pycolmap.Reconstruction, list[PassFigures]]":
    """A refined model, and what each pass did.

    Thresholds are in pixels of the working images. The model keeps all its images: one where too
    little agrees keeps its old observations, at four times the error limit. A pass that would lose
    most of the points is taken back.

    Args:
      model: from the mapper; not changed.
      read: intensities by image name; called several times per image and pass.
      refine_intrinsics: whether bundle adjustment moves focal lengths and distortion.
      threads: of bundle adjustment; one makes the model repeatable to the last byte.

    Raises:
      ImageError: an image cannot be read any more.
    """
    sizes = {}
    for image_id in sorted(model.reg_image_ids()):
        gray, scale = read(model.image(image_id).name)
        sizes[model.image(image_id).name] = ((gray.shape[1], gray.shape[0]), scale)
    figures: list[PassFigures] = []
    for number in range(config.passes):
        views, tracks = read_model_arrays(model, sizes)
        if len(tracks.points) < MIN_POINTS or len(views) < 2:
            break
        max_shift = config.max_shift_px / (1 if number == 0 else 2)
        blocks = list(_blocks(tracks, views, read, config, max_shift))
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
    return model, figures


def _adjust(
    template: "pycolmap.Reconstruction",
    views: list[View],
    tracks: Tracks,
    weak: np.ndarray,
    sizes: dict[str, tuple[tuple[int, int], tuple[float, float]]],
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
