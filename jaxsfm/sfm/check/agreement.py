"""How far the views of a model agree on what they show, counted for every two views.

A model says which of its points each view must show. Patches around these points are aligned, as in
refinement. So for every point and view there are three outcomes: the view shows the point; it shows
something else there, although nothing stands in front of the point (a *contradiction*); or nothing
can be said. Where a model has taken two places for one, its views contradict each other: each of
two groups of views sees points that the other group should see and does not.

Single contradictions say little: alignment fails on leaves, in reflections, or where a car has
driven away. They count only in blocks, if most of the tested points around them are contradictions
too. Only views that see a point from nearly the same side are compared.

Where the sun has moved between two photos, the same surface gives blocks of low correlations, too.
But then as many correlations lie between those that agree and those that contradict, and of another
surface few do. So these *undecided* points say how many contradictions the light explains, and only
the contradictions beyond it count.

Source: Zach, Irschara and Bischof 2008, "What can missing correspondences tell us about 3D
structure and motion?", and Heinly, Dunn and Frahm 2014, "Correcting for duplicate scene structure
in sparse 3D reconstruction", test models by points that views should see and do not. Both use
keypoints. Aligned patches also say that a view shows *another* surface in the same place.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import present_groups
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits
from jaxsfm.sfm.refine.track_alignment import align_blocks

OTHER_SCORE = 0.5
"""A patch shows something else if its normalised cross-correlation is lower. Patches that agree
have at least `Refinement.min_score`. Between the two, a point is undecided."""
MAX_ANGLE_DEG = 30.0
"""Views are compared on points that both see from directions that are this near."""
MAX_DISTANCE_RATIO = 1.5
"""The same for the distances of the two views from the point."""
AROUND = 6
"""The number of points of a view that tell whether a point near them is hidden."""
REACH = 0.05
"""These points lie no further away than this share of the image's longer side."""
SAME_DEPTH = 0.05
"""A point lies on the surface that the points around it show if their depths differ by no more than
this share."""
SEEN_THROUGH = 0.1
"""A point lies in front of that surface if its depth is less by this share: the view looks through
it."""
MOST = 0.7
"""The share of the points around that must say so."""
BLOCK, BLOCK_OF = 6, 8
"""A contradiction counts if so many of the nearest tested points, itself among them, are
contradictions too."""
LIGHT = 1.5
"""A change of light explains so many contradictions for each undecided point. In a model of
*statue*, 95 of 100 right pairs of photos have fewer, and 95 of 100 wrong ones have more."""
MIN_COMPARED = 20
"""Two views are compared only on this many points or more."""


class Agreement(NamedTuple):
    """Counts for every two views. The first index is the view that sees the points, the second one
    is the view that should see them."""

    tested: np.ndarray
    """int (v, v): points on which something can be said."""
    contradicted: np.ndarray
    """int (v, v): those of them that are contradictions in blocks."""
    undecided: np.ndarray
    """int (v, v): other points in these blocks, where a patch neither agrees nor contradicts."""

    def beyond_light(self, some: "slice | tuple[slice, slice]" = slice(None)) -> np.ndarray:
        """float64: the contradictions that a difference in light does not explain.

        Args:
          some: which of the counts; by default all, (v, v).
        """
        return np.maximum(self.contradicted[some] - LIGHT * self.undecided[some], 0.0)

    def copied(self) -> "Agreement":
        """The same counts in memory of their own."""
        return Agreement(*(counts.copy() for counts in self))

    def join(self, first: int, second: int) -> None:
        """Add the counts of a view, or of a group of views, to those of another one, in place."""
        for counts in self:
            counts[first] += counts[second]
            counts[:, first] += counts[:, second]


AGREES, CONTRADICTS, UNDECIDED, UNKNOWN = range(4)
"""A view shows a point; it shows something else there; its patch is neither like that of the point
nor quite unlike it; or alignment failed in another way."""


class _Tests(NamedTuple):
    """What was found for points (`point`) in views (`view`), one entry each."""

    point: np.ndarray
    view: np.ndarray
    xy: np.ndarray
    """float64 (m, 2): where the model puts the point, working pixels."""
    outcome: np.ndarray
    """int (m,): AGREES, CONTRADICTS or UNDECIDED."""


class _Seen(NamedTuple):
    """The points of a model, and which of its views show them."""

    points: np.ndarray
    """float64 (n, 3)."""
    shown: np.ndarray
    """bool (n, v)."""


def agreement(
    model: Model,
    images: DeviceImages,
    refinement: Refinement,
    *,
    targets: Sequence[int] | None = None,
    normal: np.ndarray | None = None,
) -> Agreement:
    """Compare all views of a model with each other.

    Args:
      images: those of the views, in the model's pixels.
      refinement: how patches are aligned, and when they agree.
      targets: indices of views. Only what these views show is tested. None: all views.
      normal: float64 (points, 3), of the model's points; None: from the points.
    """
    seen, tests = _tested(model, images, refinement, targets, normal)
    return _compare(model.views, seen, tests)


def _tested(
    model: Model,
    images: DeviceImages,
    refinement: Refinement,
    targets: Sequence[int] | None,
    normal: np.ndarray | None,
) -> tuple[_Seen, _Tests]:
    """Align all points in the views that should see them."""
    views, tracks = model.views, model.tracks
    points = tracks.points.copy()
    shown = np.zeros((len(points), len(views)), bool)
    if targets is not None:  # what the other views show is not tested; their tracks say it
        shown[tracks.point, tracks.view] = True
        shown[:, targets] = False
    parts = []
    limits = AlignmentLimits.of(refinement)
    every = refinement.in_all_views()
    for block in align_blocks(model, images, every, limits, targets=targets, normal=normal):
        points[block.rows] = block.patches.points
        own, found = block.confirmed, block.found
        shown[block.rows[own], block.patches.reference[own]] = True
        shown[block.rows[found.point[block.agrees]], found.view[block.agrees]] = True
        parts.append(
            (
                block.rows[found.point],
                found.view,
                found.start,
                np.select(
                    [block.agrees, block.score < OTHER_SCORE, block.score < refinement.min_score],
                    [AGREES, CONTRADICTS, UNDECIDED],
                    UNKNOWN,
                ),
            )
        )
    if not parts:  # no point may be seen in the targets
        none = np.zeros(0, int)
        return _Seen(points, shown), _Tests(none, none, np.zeros((0, 2)), none)
    point, view, xy, outcome = (np.concatenate(column) for column in zip(*parts, strict=True))
    seen = _Seen(points, shown)
    # A point that only one view shows may be a wrong match: it tests nothing.
    missing = (outcome == CONTRADICTS) | (outcome == UNDECIDED)
    missing &= (shown.sum(1) >= 2)[point]
    tested = np.flatnonzero(missing)
    for k, own in present_groups(view[tested]):
        rows = tested[own]
        # A view itself says at which depth it shows surfaces. A target does not, because its own
        # points have been left out; there the surfaces are those of the other views.
        around = np.ones(len(points), bool) if targets is not None else shown[:, k]
        missing[rows] = _not_hidden(views[k], points[around], points[point[rows]])
    keep = (outcome == AGREES) | missing
    return seen, _Tests(point[keep], view[keep], xy[keep], outcome[keep])


def _not_hidden(view: View, surface: np.ndarray, points: np.ndarray) -> np.ndarray:
    """bool (m,): of points (m, 3) that a view does not show, those that nothing stands in front of.

    Args:
      surface: float64 (n, 3), points of surfaces. Near such a point of the image, they must have
        the same depth or lie behind it.
    """
    xy, depth = view.project(surface)
    reach = REACH * max(view.size)
    with np.errstate(invalid="ignore"):  # what lies further outside is near no pixel of the image
        known = ((xy > -1 - reach) & (xy < np.asarray(view.size) + reach)).all(1)
    xy, depth = xy[known], depth[known]
    if len(xy) < AROUND or not len(points):
        return np.zeros(len(points), bool)
    at, own = view.project(points)
    distance, nearest = map(np.asarray, KDTree(xy).query(at, k=AROUND))
    near = distance < reach
    ratio = depth[nearest] / own[:, None]
    need = np.maximum(MOST * near.sum(1), AROUND / 2)
    same = (near & (np.abs(ratio - 1) < SAME_DEPTH)).sum(1) >= need
    through = (near & (ratio > 1 + SEEN_THROUGH)).sum(1) >= need
    return same | through


def _compare(views: Sequence[View], seen: _Seen, tests: _Tests) -> Agreement:
    """Count tests and contradictions for every two views."""
    count = len(views)
    found = Agreement(*(np.zeros((count, count), int) for _ in Agreement._fields))
    centres = np.asarray([view.centre for view in views])
    for b, own in present_groups(tests.view):
        rays = views[b].centre - seen.points[tests.point[own]]
        far = np.linalg.norm(rays, axis=1)
        shown = seen.shown[tests.point[own]]
        shown[:, b] = False
        for a in np.flatnonzero(shown.sum(0) >= MIN_COMPARED):
            both = np.flatnonzero(shown[:, a])
            other = centres[a] - seen.points[tests.point[own[both]]]
            away = np.linalg.norm(other, axis=1)
            cosine = np.einsum("ni,ni->n", other, rays[both]) / (away * far[both])
            ratio = np.abs(np.log(away / far[both]))
            alike = (cosine > np.cos(np.radians(MAX_ANGLE_DEG))) & (
                ratio < np.log(MAX_DISTANCE_RATIO)
            )
            rows = own[both[alike]]
            decided = rows[tests.outcome[rows] != UNDECIDED]
            if len(decided) < MIN_COMPARED:
                continue
            wrong = tests.outcome[decided] == CONTRADICTS
            _, nearest = KDTree(tests.xy[decided]).query(tests.xy[rows], k=BLOCK_OF)
            in_block = wrong[nearest].sum(1) >= BLOCK
            found.tested[a, b] = len(decided)
            found.contradicted[a, b] = (in_block & (tests.outcome[rows] == CONTRADICTS)).sum()
            found.undecided[a, b] = (in_block & (tests.outcome[rows] == UNDECIDED)).sum()
    return found
