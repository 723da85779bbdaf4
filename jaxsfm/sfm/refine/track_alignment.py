"""The alignment of refinement: all observations a model's points have or could have, moved onto
their reference patches, block by block of points.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxsfm.colmap.model import Tracks, View
from jaxsfm.config import Refinement
from jaxsfm.core import align as align_core
from jaxsfm.io.photos import Reader
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.refine.padding import chunks, padded

CELLS = 5_000_000
"""Points times views looked at together; about 100 bytes each, and 2.7 kB for each point."""
MIN_BLOCK, MAX_BLOCK = 1000, 100_000
"""Points of a block, whatever the number of views."""


SLACK = 0.25
"""Of a view's sides, beyond its borders: points move along their reference rays before alignment,
by at most 5 % of their depth."""


class AlignedBlock(NamedTuple):
    """The outcome of alignment for some of the points."""

    rows: np.ndarray
    """The points, indices."""
    points: np.ndarray
    """Where they lie now: on their reference rays."""
    reference: np.ndarray
    xy: np.ndarray
    """The reference keypoints."""
    found: plane_geometry.Candidates
    """Their `point` counts within the block."""
    moved: np.ndarray
    agrees: np.ndarray
    tracked: np.ndarray
    """Candidates that are observations of the old tracks."""


def _templates(
    reference: np.ndarray,
    xy: np.ndarray,
    wanted: np.ndarray,
    views: list[View],
    read: Reader,
    patch: align_core.Patch,
) -> align_core.Templates:
    """Templates of the wanted points, one view's image in memory at a time."""
    n, q = len(reference), len(patch.weights)
    store = [
        np.zeros((n, q, 1), np.float32),
        np.zeros((n, q, 1, 2), np.float32),
        np.zeros((n, 2, 2), np.float32),
        np.zeros(n, np.float32),
        np.zeros(n, bool),
    ]
    for k in np.unique(reference[wanted]):
        image, size = padded(read(views[k].name)[0])
        for piece, count in chunks(wanted[reference[wanted] == k]):
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
    found: plane_geometry.Candidates,
    templates: align_core.Templates,
    views: list[View],
    read: Reader,
    patch: align_core.Patch,
    config: Refinement,
    max_shift_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Where the candidates end, and which agree with their templates."""
    moved = found.start.copy()
    agrees = np.zeros(len(moved), bool)
    for k in np.unique(found.view):
        image, size = padded(read(views[k].name)[0])
        for piece, count in chunks(np.flatnonzero(found.view == k)):
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


def neighbourhoods(tracks: Tracks, count: int) -> np.ndarray:
    """The points (n,) in an order in which those that the same views see are near each other: by
    their first view, where views that see the same are near each other (reverse Cuthill-McKee)."""
    shape = (len(tracks.points), count)
    seen = coo_array((np.ones(len(tracks.point)), (tracks.point, tracks.view)), shape=shape).tocsr()
    place = np.empty(count, int)
    place[reverse_cuthill_mckee((seen.T @ seen).tocsr(), symmetric_mode=True)] = np.arange(count)
    first = np.full(len(tracks.points), count)
    np.minimum.at(first, tracks.point, place[tracks.view])
    return np.argsort(first, kind="stable")


def may_show(points: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """Whether points (n, 3) could become candidates in any of the views."""
    shown = np.zeros(len(points), bool)
    for view in views:
        at, _ = view.project(points)
        reach = SLACK * np.asarray(view.size)
        with np.errstate(invalid="ignore"):
            shown |= ((at >= -reach) & (at <= view.size + reach)).all(1)
    return shown


def align_blocks(
    tracks: Tracks,
    views: list[View],
    read: Reader,
    config: Refinement,
    max_shift_px: float,
    *,
    targets: Sequence[int] | None = None,
) -> Iterator[AlignedBlock]:
    """Align every point's observations, so many points at a time that memory stays bounded, and
    those together that the same views see.

    Args:
      tracks: every point has an observation.
      targets: only observations in these views, and only blocks of points that they may show: the
        work is theirs, not the model's.
    """
    normal = plane_geometry.normals(tracks, views, neighbours=config.neighbours)
    patch = align_core.square_patch(config.radius)
    step = max(MIN_BLOCK, min(CELLS // len(views), MAX_BLOCK))
    near = neighbourhoods(tracks, len(views))
    if targets is not None:
        near = near[may_show(tracks.points, [views[k] for k in targets])[near]]
    count = -(-len(near) // step)
    block = np.full(len(tracks.points), count)
    block[near] = np.arange(len(near)) // step
    order = np.lexsort((tracks.point, block[tracks.point]))
    ends = np.searchsorted(block[tracks.point][order], np.arange(count + 1))
    for number, first in enumerate(range(0, len(near), step)):
        rows = np.sort(near[first : first + step])
        own = order[ends[number] : ends[number + 1]]
        part = Tracks(
            tracks.points[rows],
            np.searchsorted(rows, tracks.point[own]),
            tracks.view[own],
            tracks.xy[own],
        )
        seen = plane_geometry.visibility(part, views, normal[rows])
        reference = plane_geometry.reference_views(seen)
        xy = seen.xy[np.arange(len(rows)), reference]
        points = plane_geometry.on_reference_rays(part, views, normal[rows], reference, xy)
        found = plane_geometry.candidates(
            points,
            views,
            normal[rows],
            reference,
            xy,
            seen,
            margin=config.radius + 2,
            min_cosine=config.min_cosine,
            max_stretch=config.max_stretch,
            targets=targets,
        )
        templates = _templates(reference, xy, np.unique(found.point), views, read, patch)
        moved, agrees = _align(found, templates, views, read, patch, config, max_shift_px)
        tracked = seen.tracked[found.point, found.view]
        yield AlignedBlock(rows, points, reference, xy, found, moved, agrees, tracked)
