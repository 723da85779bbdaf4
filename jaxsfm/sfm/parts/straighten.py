"""Long rows of photos, unbent: they are adjusted part by part before they are adjusted as a whole.

The solver of a bundle adjustment moves points and cameras along straight lines. To unbend a row,
they must move along arcs, so each step unbends it a little, and a row of 1000 photos stays bent
when the solver ends. A short part of the row is bent by a few degrees only. It is adjusted by
itself, and the parts are put together by the photos that they share. What is left to the whole is
small (docs/decisions/many-photos.md).
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.view import View
from jaxsfm.sfm.evaluation import umeyama
from jaxsfm.sfm.model_join import MIN_SHARED
from jaxsfm.sfm.parts.frames import SharedPoints, common_frames
from jaxsfm.sfm.parts.merge import merged
from jaxsfm.sfm.parts.partition import Graph, overlapping_parts

TOGETHER = 20
"""Photos with so many common points hold each other. Fewer may all be wrong: with one point, photos
of look-alike houses came into one part, whose two ends nothing held together."""
LONG = 20
"""Steps from photo to photo (`TOGETHER`) between the two ends of a row that is long. A street of
100 photos has 8 and one of 1000 has 86; 500 frames of *kitchen* have 8, *statue* 5, *cup* 3."""
PART, OVERLAP = 30, 20
"""Photos of a part, and photos that two parts share: parts of 80 are still bent after 50 steps."""
RIGHT = 0.9
"""The parts fit together if this share of the observations has no larger error than is allowed."""


def straightened(model: Model, *, error_px: float, loss_px: float, threads: int) -> Model | None:
    """A long row of photos after its parts were adjusted; None if it is no long row, or if the
    parts do not fit together.

    The cameras stay as they are.

    Args:
      error_px: the largest error of a right observation, pixels of the views.
      loss_px, threads: as in `jaxsfm.colmap.bundle_adjustment`.
    """
    graph = seen_together(model)
    if hops(graph) < LONG:
        return None
    parts = []
    for names in overlapping_parts(graph, size=PART, overlap=OVERLAP):
        made = model.part(names)[0].to_colmap()
        bundle_adjust(made, loss_px=loss_px, refine_intrinsics=False, threads=threads)
        parts.append(Model.from_colmap(made, model.sizes))
    shared = {
        (i, j): found
        for i, first in enumerate(parts)
        for j, second in enumerate(parts[i + 1 :], i + 1)
        if (found := shared_views(first.views, second.views)) is not None
    }
    frames, *others = common_frames(len(parts), shared)
    if others:
        return None
    whole = merged(parts, frames)
    right = int((whole.errors_px() < error_px).sum())
    return whole if right >= RIGHT * len(model.tracks.point) else None


def seen_together(model: Model) -> Graph:
    """The photos of a model, and how many points each two of them share, from `TOGETHER` on."""
    names = sorted(view.name for view in model.views)
    place = {name: k for k, name in enumerate(names)}
    own = np.asarray([place[view.name] for view in model.views], np.int64)
    tracks = model.tracks
    shape = (len(tracks.points), len(names))
    seen = coo_array((np.ones(len(tracks.point)), (tracks.point, own[tracks.view])), shape=shape)
    both = (seen.T @ seen).tocoo()
    keep = (both.row != both.col) & (both.data >= TOGETHER)
    entries = (both.data[keep], (both.row[keep], both.col[keep]))
    return Graph(names, csr_array(coo_array(entries, shape=both.shape)))


def hops(graph: Graph) -> int:
    """The steps from photo to photo between the two ends of a graph, as far as photos are
    connected with the first one."""
    if not graph.names:
        return 0
    reached = dijkstra(graph.weights, directed=False, indices=0, unweighted=True)
    end = int(np.where(np.isfinite(reached), reached, -1).argmax())
    back = dijkstra(graph.weights, directed=False, indices=end, unweighted=True)
    return int(back[np.isfinite(back)].max())


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
