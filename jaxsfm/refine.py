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
    filter_points,
    read_model_arrays,
)

if TYPE_CHECKING:
    import pycolmap

ReadGray = Callable[[str], tuple[np.ndarray, tuple[float, float]]]
"""Image name -> float32 (h, w) intensities of the working image, original pixels per pixel."""
CHUNK = 4096
"""Keypoints aligned by one call of the compiled program."""
BLOCK = 100_000
"""Points whose templates are held at once: 2.7 kB each."""
MIN_POINTS = 10
"""A model with fewer points is left alone."""
PAD = 128
"""Maps are padded to multiples of this, so that few image sizes mean few compilations."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PassFigures:
    """What one pass did."""

    candidates: int
    kept: int
    """Observations of the tracks before the pass that agreed with their reference."""
    dropped: int
    added: int
    points: int
    reprojection_error_px: float


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


class _Alignment(NamedTuple):
    xy: np.ndarray
    agrees: np.ndarray


def _align(
    found: surface.Candidates,
    reference: np.ndarray,
    xy: np.ndarray,
    views: list[View],
    read: ReadGray,
    config: Refinement,
    max_shift_px: float,
) -> _Alignment:
    """Align all candidates, one view's image in memory at a time."""
    patch = align_core.square_patch(config.radius)
    q = len(patch.weights)
    moved = found.start.copy()
    agrees = np.zeros(len(moved), bool)
    for first in range(0, len(reference), BLOCK):
        block = np.arange(first, min(first + BLOCK, len(reference)))
        n = len(block)
        store = align_core.Templates(
            np.zeros((n, q, 1), np.float32),  # pyright: ignore[reportArgumentType]
            np.zeros((n, q, 1, 2), np.float32),  # pyright: ignore[reportArgumentType]
            np.zeros((n, 2, 2), np.float32),  # pyright: ignore[reportArgumentType]
            np.zeros(n, np.float32),  # pyright: ignore[reportArgumentType]
            np.zeros(n, bool),  # pyright: ignore[reportArgumentType]
        )
        for k, view in enumerate(views):
            rows = block[reference[block] == k]
            if not len(rows):
                continue
            image, size = _padded(read(view.name)[0])
            for piece, count in _chunks(rows):
                made = align_core.make_templates(image, size, np.float32(xy[piece]), patch)  # pyright: ignore
                for held, new in zip(store, jax.device_get(made), strict=True):
                    held[piece[:count] - first] = new[:count]  # pyright: ignore
        in_block = (found.point >= first) & (found.point < first + n)
        for k, view in enumerate(views):
            rows = np.flatnonzero(in_block & (found.view == k))
            if not len(rows):
                continue
            image, size = _padded(read(view.name)[0])
            for piece, count in _chunks(rows):
                result = jax.device_get(
                    align_core.align(
                        image,  # pyright: ignore[reportArgumentType]
                        size,  # pyright: ignore[reportArgumentType]
                        jax.tree.map(lambda a, p=found.point[piece] - first: a[p], store),
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
    return _Alignment(moved, agrees)


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

    Thresholds in pixels are those of the working images. The model keeps its images, also those
    that lose all their observations. A model whose points all fail comes back as it was.

    Args:
      model: from the mapper; not changed.
      read: intensities by image name; called several times per image and pass.
      refine_intrinsics: whether bundle adjustment moves focal lengths and distortion.
      threads: of bundle adjustment; one makes the model repeatable to the last byte.
    """
    sizes = {}
    for image_id in sorted(model.reg_image_ids()):
        gray, scale = read(model.image(image_id).name)
        sizes[model.image(image_id).name] = ((gray.shape[1], gray.shape[0]), scale)
    unit = float(np.median([np.mean(scale) for _, scale in sizes.values()]))
    figures: list[PassFigures] = []
    for number in range(config.passes):
        views, tracks = read_model_arrays(model, sizes)
        if len(tracks.points) < MIN_POINTS or len(views) < 2:
            break
        max_shift = config.max_shift_px / (1 if number == 0 else 2)
        refined, found, agrees, seen = _observations(tracks, views, read, config, max_shift)
        fresh = build_model(model, views, refined)
        if fresh.num_points3D() < MIN_POINTS:
            break
        # Coarse filter first: a point far behind or beside its plane makes the solver fail.
        filter_points(fresh, max_error_px=4 * config.max_error_px * unit)
        bundle_adjust(fresh, loss_px=unit, refine_intrinsics=refine_intrinsics, threads=threads)
        interrupt.check()
        filter_points(fresh, max_error_px=config.max_error_px * unit)
        bundle_adjust(fresh, loss_px=unit, refine_intrinsics=refine_intrinsics, threads=threads)
        interrupt.check()
        if fresh.num_points3D() < MIN_POINTS:
            break
        model = fresh
        old = seen.tracked[found.point, found.view]
        figures.append(
            PassFigures(
                candidates=len(found.point),
                kept=int((agrees & old).sum()),
                dropped=int((~agrees & old).sum()),
                added=int((agrees & ~old).sum()),
                points=model.num_points3D(),
                reprojection_error_px=model.compute_mean_reprojection_error(),
            )
        )
        on_pass()
    return model, figures


def _observations(
    tracks: Tracks, views: list[View], read: ReadGray, config: Refinement, max_shift_px: float
) -> tuple[Tracks, surface.Candidates, np.ndarray, surface.Visibility]:
    """New tracks: every point's reference keypoint and the observations that agree with it."""
    normal = surface.normals(tracks, views, neighbours=config.neighbours)
    seen = surface.visibility(tracks, views, normal)
    reference = surface.reference_views(seen)
    xy = seen.xy[np.arange(len(reference)), reference]
    points = surface.on_reference_rays(tracks, views, normal, reference, xy)
    found = surface.candidates(
        points,
        views,
        normal,
        reference,
        xy,
        seen,
        margin=config.radius + 2,
        min_cosine=config.min_cosine,
        max_stretch=config.max_stretch,
    )
    aligned = _align(found, reference, xy, views, read, config, max_shift_px)
    good = aligned.agrees
    own = np.unique(found.point[good])
    refined = Tracks(
        points,
        np.concatenate([own, found.point[good]]),
        np.concatenate([reference[own], found.view[good]]),
        np.concatenate([xy[own], aligned.xy[good]]),
    )
    return refined, found, good, seen
