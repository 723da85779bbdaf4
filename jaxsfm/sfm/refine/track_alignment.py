"""The alignment of whole tracks: every observation that a point of the model has, or could have, is
moved onto the point's reference patch. Points are taken in blocks, so that memory stays bounded.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Observations, Tracks, present_groups
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.core.align import Aligned, Patch, Templates, square_patch
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.refine.candidates import (
    Candidates,
    find_candidates,
    may_be_candidates,
    may_show,
)
from jaxsfm.sfm.refine.device_images import DeviceImages, DeviceTemplates, chunks
from jaxsfm.sfm.refine.patch_alignment import (
    AlignmentLimits,
    align_patches,
    make_templates,
    overlapped,
    to_host,
)
from jaxsfm.sfm.refine.plane_geometry import ReferencePatches

CELLS = 5_000_000
"""Points times views that are looked at together. Each takes about 100 bytes. Each point takes
2.7 kB on the device, rounded up to a power of two of points."""
MIN_BLOCK, MAX_BLOCK = 1000, 100_000
"""Points of a block, whatever the number of views."""


class AlignedBlock(NamedTuple):
    """The outcome of alignment for some of the points."""

    rows: np.ndarray
    """int (n,): which points."""
    patches: ReferencePatches
    """Their patches; the points lie on their reference rays."""
    found: Candidates
    """Its `point` counts within the block."""
    moved: np.ndarray
    """float64 (m, 2): where the candidates ended, working pixels."""
    score: np.ndarray
    """float (m,): their normalised cross-correlation with their patches there, -1 .. 1."""
    agrees: np.ndarray
    """bool (m,): which candidates agree with their patches."""
    tracked: np.ndarray
    """bool (m,): which candidates are observations of the old tracks."""
    before: np.ndarray
    """float64 (m, 2): where these observations were, working pixels; NaN for the others."""

    @property
    def confirmed(self) -> np.ndarray:
        """int, ascending: the points of the block that at least one candidate agrees with."""
        return np.unique(self.found.point[self.agrees])

    def observations(self) -> list[Observations]:
        """The confirmed points' reference keypoints, and the candidates that agree.

        Their `point` counts within all points.
        """
        own, good = self.confirmed, np.flatnonzero(self.agrees)
        return [
            Observations(self.rows[own], self.patches.reference[own], self.patches.xy[own]),
            Observations(
                self.rows[self.found.point[good]], self.found.view[good], self.moved[good]
            ),
        ]


def _templates(
    patches: ReferencePatches,
    wanted: np.ndarray,
    views: Sequence[View],
    images: DeviceImages,
    patch: Patch,
) -> DeviceTemplates:
    """Templates of the wanted patches."""
    templates = DeviceTemplates(len(patches.points), len(wanted))
    reference = patches.reference[wanted]

    def started() -> Iterator[list[tuple[np.ndarray, Templates]]]:
        for k, rows in present_groups(reference):
            image = images.take(views[k].name)
            yield [
                (piece[:count], make_templates(image, patches.xy[piece], patch))
                for piece, count in chunks(wanted[rows])
            ]

    for of_one_view in overlapped(started()):
        for rows, made in of_one_view:
            templates.put(rows, made)
    return templates


def _align(
    found: Candidates,
    templates: DeviceTemplates,
    views: Sequence[View],
    images: DeviceImages,
    patch: Patch,
    limits: AlignmentLimits,
    *,
    iterations: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the candidates end, their scores there, and which agree with their templates."""
    moved = found.start.copy()
    score = np.zeros(len(moved))
    agrees = np.zeros(len(moved), bool)

    def started() -> Iterator[tuple[np.ndarray, list[tuple[int, Aligned]]]]:
        # Templates were made in ascending order of views. Backwards, the images that were taken
        # last are used first (`DeviceImages`).
        for k, rows in reversed(present_groups(found.view)):
            image, calls = images.take(views[k].name), []
            for piece, count in chunks(rows):
                some = templates.take(found.point[piece])
                start, affine = found.start[piece], found.affine[piece]
                outcome = align_patches(image, some, start, affine, patch, iterations=iterations)
                calls.append((count, outcome))
            yield rows, calls

    for rows, calls in overlapped(started()):
        result = to_host(calls)
        moved[rows] = result.xy
        score[rows] = result.score
        agrees[rows] = limits.accept(result, found.start[rows])
    return moved, score, agrees


def neighbourhoods(tracks: Tracks, count: int) -> np.ndarray:
    """The indices (n,) of points, so that those that the same views see are near each other.

    Points are ordered by their first view, and the `count` views so that those that see the same
    points follow each other (reverse Cuthill-McKee).
    """
    shape = (len(tracks.points), count)
    seen = coo_array((np.ones(len(tracks.point)), (tracks.point, tracks.view)), shape=shape).tocsr()
    place = np.empty(count, int)
    place[reverse_cuthill_mckee((seen.T @ seen).tocsr(), symmetric_mode=True)] = np.arange(count)
    first = np.full(len(tracks.points), count)
    np.minimum.at(first, tracks.point, place[tracks.view])
    return np.argsort(first, kind="stable")


def _blocks(
    tracks: Tracks, views: int, wanted: np.ndarray | None
) -> Iterator[tuple[np.ndarray, Tracks]]:
    """Blocks of points that the same views see: their indices, and their tracks.

    Args:
      wanted: bool (n,), the points; None: all.
    """
    step = max(MIN_BLOCK, min(CELLS // views, MAX_BLOCK))
    near = neighbourhoods(tracks, views)
    if wanted is not None:
        near = near[wanted[near]]
    count = -(-len(near) // step)
    block = np.full(len(tracks.points), count)
    block[near] = np.arange(len(near)) // step
    order = np.lexsort((tracks.point, block[tracks.point]))
    ends = np.searchsorted(block[tracks.point][order], np.arange(count + 1))
    for number in range(count):
        rows = np.sort(near[number * step : (number + 1) * step])
        own = order[ends[number] : ends[number + 1]]
        yield (
            rows,
            Tracks(
                tracks.points[rows],
                np.searchsorted(rows, tracks.point[own]),
                tracks.view[own],
                tracks.xy[own],
            ),
        )


def align_blocks(
    model: Model,
    images: DeviceImages,
    refinement: Refinement,
    limits: AlignmentLimits,
    *,
    targets: Sequence[int] | None = None,
    normal: np.ndarray | None = None,
) -> Iterator[AlignedBlock]:
    """Align the observations of every point of a model, block by block.

    Args:
      model: every point has an observation.
      images: those of the views, in the model's pixels.
      limits: what an aligned keypoint must fulfil to count.
      targets: indices of views. Only observations in these views are aligned, and only points of
        which they may become candidates are looked at. None: all views.
      normal: float64 (points, 3), of the model's points; None: from the points.
    """
    if normal is None:
        normal = plane_geometry.normals(model, neighbours=refinement.neighbours)
    patch = square_patch(refinement.radius)
    wanted = None if targets is None else may_be_candidates(model, normal, refinement, targets)
    for rows, tracks in _blocks(model.tracks, len(model.views), wanted):
        part, number = _of_near_views(model.with_tracks(tracks), targets)
        views = part.views
        among = None if targets is None else np.flatnonzero(np.isin(number, targets)).tolist()
        seen = plane_geometry.visibility(part, normal[rows])
        patches = plane_geometry.reference_patches(part, normal[rows], seen)
        found = find_candidates(views, patches, seen, refinement, targets=among)
        templates = _templates(patches, np.unique(found.point), views, images, patch)
        moved, score, agrees = _align(
            found, templates, views, images, patch, limits, iterations=refinement.iterations
        )
        # Otherwise they would stay on the device beside those of the next block.
        del templates
        tracked, before = (each[found.point, found.view] for each in (seen.tracked, seen.xy))
        patches = patches._replace(reference=number[patches.reference])
        found = found._replace(view=number[found.view])
        yield AlignedBlock(rows, patches, found, moved, score, agrees, tracked, before)


def _of_near_views(part: Model, targets: Sequence[int] | None) -> tuple[Model, np.ndarray]:
    """A block with only those views that matter to it; int (v,), their indices.

    These are the views that observe one of its points, and those in which it is looked for: the
    targets, or all that may show one of its points. The time of a block then depends on the photos
    around it, and not on all photos of the model.
    """
    near = np.bincount(part.tracks.view, minlength=len(part.views)) > 0
    if targets is not None:
        near[list(targets)] = True
    else:
        for k in np.flatnonzero(~near):
            near[k] = may_show(part.tracks.points, [part.views[k]]).any()
    number = np.flatnonzero(near)
    place = np.cumsum(near) - 1
    tracks = part.tracks._replace(view=place[part.tracks.view])
    return dataclasses.replace(part, views=[part.views[k] for k in number], tracks=tracks), number
