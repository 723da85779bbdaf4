"""Long rows of photos, unbent: they are adjusted part by part before they are adjusted as a whole.

The solver of a bundle adjustment moves points and cameras along straight lines. To unbend a row,
they must move along arcs, so each step unbends it a little, and a row of 1000 photos stays bent
when the solver ends. A short part of the row is bent by a few degrees only. It is adjusted by
itself, and the parts are put together by the photos that they share. What is left to the whole is
small (docs/decisions/many-photos.md).
"""

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.view import View
from jaxsfm.sfm.evaluation import Similarity, umeyama
from jaxsfm.sfm.parts.frames import SharedPoints, common_frames
from jaxsfm.sfm.parts.partition import Graph, overlapping_parts

TOGETHER = 20
"""Photos with so many common points hold each other. Fewer may all be wrong: with one point, photos
of look-alike houses came into one part, whose two ends nothing held together."""
STRONGEST = 3
"""The strongest pairs of each photo hold it, too, so that a weak photo is in a part with others."""
LONG = 20
"""Steps from photo to photo between the two ends of a row that is long. A street of 100 photos has
8 and one of 1000 has 86; 500 frames of *kitchen* have 8, *statue* 5, *cup* 3."""
PART, OVERLAP = 30, 20
"""Photos of a part, and photos that two parts share: parts of 80 are still bent after 50 steps."""
MIN_SHARED = 3
"""The least number of photos that say how two parts lie to each other. Two share a pair, which may
be false in both."""
TIED, KEPT = 10, 0.5
"""Two parts with so many common right points stay tied if this share of them stays right: where a
row comes back to its start, its ends must not be torn apart."""


class _Part(NamedTuple):
    """A part of a row after its own adjustment."""

    model: Model
    rows: np.ndarray
    """int (points,): the indices of its points in the row."""


def straightened(model: Model, *, error_px: float, loss_px: float, threads: int) -> Model | None:
    """A long row of photos after its parts were adjusted; None if it is no long row, or if the
    parts do not fit together.

    Poses and points change; observations and cameras stay. The frame is that of the largest part,
    which has the place and the size that it had in the row.

    Args:
      error_px: the largest error of a right observation, pixels of the views.
      loss_px, threads: as in `jaxsfm.colmap.bundle_adjustment`.
    """
    graph = seen_together(model)
    groups, _ = connected_components(graph.weights, directed=False)
    if groups != 1 or hops(graph) < LONG:
        return None

    def adjusted(names: Sequence[str]) -> _Part:
        """A part of the row, adjusted by itself; its cameras stay."""
        some, rows = model.part(names)
        made, index = some.numbered_colmap()
        bundle_adjust(made, loss_px=loss_px, refine_intrinsics=False, threads=threads)
        kept = [index[number] for number in sorted(made.point3D_ids())]
        return _Part(Model.from_colmap(made, model.sizes), rows[kept])

    parts = [adjusted(names) for names in overlapping_parts(graph, size=PART, overlap=OVERLAP)]
    parts.sort(key=lambda part: -len(part.model.views))
    shared = {
        (i, j): found
        for i, first in enumerate(parts)
        for j, second in enumerate(parts[i + 1 :], i + 1)
        if (found := shared_views(first.model.views, second.model.views)) is not None
    }
    frames, *others = common_frames(len(parts), shared)
    if others:
        return None
    of_photo = homes({number: part.model for number, part in enumerate(parts)})
    home = [of_photo[view.name] for view in model.views]
    whole = _put_together(model, parts, frames, home)
    return whole if _stays_tied(model, whole, home, error_px) else None


def seen_together(model: Model) -> Graph:
    """The photos of a model, and how many points each two of them share: pairs from `TOGETHER` on,
    and the `STRONGEST` of each photo."""
    names = sorted(view.name for view in model.views)
    place = {name: k for k, name in enumerate(names)}
    own = np.asarray([place[view.name] for view in model.views], np.int64)
    tracks = model.tracks
    seen = _incidence(tracks.point, own[tracks.view], (len(tracks.points), len(names)))
    both = (seen.T @ seen).tocoo()
    apart = both.row != both.col
    row, column, count = both.row[apart], both.col[apart], both.data[apart]
    order = np.lexsort((column, -count, row))
    rank = np.empty(len(row), np.int64)
    rank[order] = np.arange(len(row)) - np.searchsorted(row[order], row[order])
    keep = (count >= TOGETHER) | (rank < STRONGEST)
    one_way = csr_array(coo_array((count[keep], (row[keep], column[keep])), shape=both.shape))
    return Graph(names, csr_array(one_way.maximum(one_way.T)))


def hops(graph: Graph) -> int:
    """The steps from photo to photo between the two ends of a graph whose photos are connected."""
    steps = functools.partial(dijkstra, graph.weights, directed=False, unweighted=True)
    return int(steps(indices=int(steps(indices=0).argmax())).max())


def shared_views(first: Sequence[View], second: Sequence[View]) -> SharedPoints | None:
    """How two models lie to each other by the photos that both have; None if these are too few or
    stand in one place.

    A photo counts as four points: its centre, and one on each axis of its camera, as far away as
    photos are from each other. So the photos of a straight row say how it is turned about itself.
    """
    theirs = {view.name: view for view in second}
    both = [(view, theirs[view.name]) for view in first if view.name in theirs]
    if len(both) < MIN_SHARED:
        return None
    tips = []
    for views in zip(*both, strict=True):
        centres = np.stack([view.centre for view in views])
        axes = np.stack([view.rotation for view in views])
        length = float(np.linalg.norm(centres - centres.mean(0), axis=1).mean())
        if not length:
            return None
        tips.append(np.concatenate([centres, (centres[:, None] + length * axes).reshape(-1, 3)]))
    return SharedPoints(tips[0], tips[1], umeyama(tips[1], tips[0]))


def homes(models: Mapping[int, Model]) -> dict[str, tuple[int, View]]:
    """For each photo, the number of the model in which it has most observations, the first of equal
    ones, and its view there."""
    most: dict[str, int] = {}
    found: dict[str, tuple[int, View]] = {}
    for number, model in models.items():
        seen = np.bincount(model.tracks.view, minlength=len(model.views))
        for view, count in zip(model.views, seen.tolist(), strict=True):
            if count > most.get(view.name, -1):
                most[view.name], found[view.name] = count, (number, view)
    return found


def _incidence(row: np.ndarray, column: np.ndarray, shape: tuple[int, int]) -> csr_array:
    """A matrix of ones at some places (n,), each once."""
    found = csr_array(coo_array((np.ones(len(row)), (row, column)), shape=shape))
    found.data[:] = 1
    return found


def _put_together(
    model: Model,
    parts: Sequence[_Part],
    frames: Mapping[int, Similarity],
    home: Sequence[tuple[int, View]],
) -> Model:
    """The row with the poses of its parts, and with points in the middle of where parts have them.

    A point that is in no part keeps its place before the first view that observes it.

    Args:
      home: for each view of the row, the number of its part, and its view there (`homes`).
    """
    views = [
        view.at(frames[number].moved(there.pose))
        for view, (number, there) in zip(model.views, home, strict=True)
    ]
    tracks, points = model.tracks, np.zeros_like(model.tracks.points)
    times = np.zeros(len(points))
    for number, part in enumerate(parts):
        points[part.rows] += frames[number].moved_points(part.model.tracks.points)
        times[part.rows] += 1
    points[times > 0] /= times[times > 0, None]
    first = np.full(len(points), -1)
    first[tracks.point[::-1]] = tracks.view[::-1]
    for k in np.flatnonzero((times == 0) & (first >= 0)):
        before, after = model.views[first[k]], views[first[k]]
        away = before.rotation @ (tracks.points[k] - before.centre)
        points[k] = after.centre + frames[home[first[k]][0]].scale * after.rotation.T @ away
    return model.with_views(views).with_tracks(tracks._replace(points=points))


def _stays_tied(
    before: Model, after: Model, home: Sequence[tuple[int, View]], error_px: float
) -> bool:
    """Whether what was right within each part and between each two parts is so afterwards."""
    tracks, part = before.tracks, np.asarray([number for number, _ in home])
    shape = (len(tracks.points), int(part.max()) + 1)
    ties = []
    right = np.ones(len(tracks.points), bool)
    for model in (before, after):
        wrong = ~(model.errors_px() < error_px)
        right[tracks.point[wrong]] = False
        own = right[tracks.point]
        seen = _incidence(tracks.point[own], part[tracks.view[own]], shape)
        ties.append((seen.T @ seen).toarray())
    return bool((ties[1] >= KEPT * ties[0])[ties[0] >= TIED].all())
