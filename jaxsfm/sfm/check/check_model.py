"""The check of one model after mapping: do its photos, its pairs and its depths agree with it?

It is asked of some of the model's points (`thinned`). Whether photos fit into the model in a second
place takes longer to say, and is asked of models that are kept (`jaxsfm.sfm.check.pose_ambiguity`).
"""

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.check.agreement import Agreement, agreement
from jaxsfm.sfm.check.grouping import (
    CURVE,
    MAX_CONTRADICTED,
    Grouping,
    consistent_components,
    disagreement,
    group_views,
    share,
)
from jaxsfm.sfm.check.model_check import MIN_VIEWS, Contradiction, ModelCheck
from jaxsfm.sfm.limits import CHECK
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import MATCH_ERROR_PX, matched_points

MIN_CHECKED_POINTS = 30
"""A model with fewer points is not checked."""
CHECKED_BY = (
    "radius",
    "iterations",
    "min_score",
    "max_sigma_px",
    "max_shift_px",
    "min_cosine",
    "max_stretch",
    "neighbours",
)
"""Fields of `Refinement` that a check depends on."""
MOST_SPREAD = 100.0
"""Photos of one scene see their points at distances that differ by no more than this factor. True
models have factors of up to 15, and broken ones of 130 to 200 000
(docs/decisions/repeated-structure.md)."""
OUTER = 5.0
"""Per cent of the photos that are left out at either end, as single photos may be misplaced."""
POINTS_PER_VIEW, MAX_POINTS = 1000, 100_000
"""At most so many points of a model are tested, per view and in all. Each is seen by several views,
so every view has more than these to show."""
OBSERVED_PER_VIEW = 2500
"""Points are tested until each view observes so many, on average. In a video each point is seen by
many views: with 1000 points per view, the check of 50 frames of kitchen took a third longer than
COLMAP's verification of their pairs (63 and 47 s), and with this limit a tenth less."""
TRIED_PER_VIEW, TRIED_POINTS = 4000, 2000
"""Points are tested until each view has so many to try, on average, whether it observes them or
not. The average is that of so many points. In a video many views may show a point."""
FACING = 0.25
"""Views that see a point from the side of those that observe it: the least cosine of the angle
between their directions, as between a view and a surface (`Refinement.min_cosine`)."""


class VerifiedMatches(NamedTuple):
    """The matches that a model may rest on."""

    matches: Mapping[Pair, PairResult]
    """By pair, original pixels."""
    pairs: Collection[Pair]
    """Those that COLMAP verified."""
    seed: int
    """For RANSAC."""


class Checked(NamedTuple):
    """The outcome of a check."""

    check: ModelCheck
    rejected: dict[Pair, Contradiction]
    """Pairs that agree with the model and whose two photos contradict each other there."""
    rejection_candidates: dict[Pair, Contradiction]
    """Pairs that agree with the model and join groups that contradict each other. Some of them may
    be right: then the groups were joined wrongly elsewhere."""
    explained: set[Pair]
    """Pairs that agree with the model and join no groups that contradict each other."""
    against: set[Pair]
    """Pairs that do not agree with the model."""
    components: list[list[str]]
    """The photos in parts in which no groups contradict each other and something holds the groups
    together, the largest first. Right models of ordinary photos are one part."""


def check_model(
    model: Model, images: DeviceImages, given: VerifiedMatches, refinement: Refinement
) -> Checked | None:
    """Check a model.

    If groups of its photos contradict each other, the pairs that joined them are rejected. Second
    places are not looked for.

    Args:
      images: those of the views, in the model's pixels.
      refinement: how patches are aligned, and when they agree.

    Returns:
      None if the model is too small.

    Raises:
      ImageError: an image of the model cannot be read any more.
    """
    if len(model.views) < MIN_VIEWS or len(model.tracks.points) < MIN_CHECKED_POINTS:
        return None
    seen, near = model.tracks, scale_drift(model)
    model = thinned(model)
    names = [view.name for view in model.views]
    found = agreement(model, images, refinement)
    grouping = group_views(found)
    contradictions = _named(grouping, names)
    normal = plane_geometry.normals(model, neighbours=refinement.neighbours)
    fits = pair_fits(model, normal, given.matches, given.pairs)
    rejected, rejection_candidates = {}, {}
    for least in (CHECK.fit, *CHECK.lower_fits) if contradictions else ():
        fitting = [p for p, fit in fits.items() if fit >= least]
        rejected = _rejected(found, names, fitting)
        rejection_candidates = {
            pair: each
            for pair in fitting
            for each in contradictions
            if each.joined_by(pair) and pair not in rejected
        }
        if rejected or rejection_candidates:
            break
    groups = [sorted(names[k] for k in group) for group in grouping.groups]
    check = ModelCheck(
        groups=groups,
        contradictions=contradictions,
        pose_ambiguities=[],
        scale_drift=near,
        doubt=CURVE.probability(disagreement(found)),
    )
    agreeing = {pair for pair, fit in fits.items() if fit >= CHECK.fit}
    explained = {p for p in agreeing if not any(each.joined_by(p) for each in contradictions)}
    whole = consistent_components(grouping, seen.view, seen.point)
    apart = [sorted(names[k] for k in part) for part in whole]
    return Checked(check, rejected, rejection_candidates, explained, fits.keys() - agreeing, apart)


def _rejected(found: Agreement, names: list[str], fitting: list[Pair]) -> dict[Pair, Contradiction]:
    """The pairs whose two photos contradict each other."""
    index = {name: k for k, name in enumerate(names)}
    against = found.beyond_light()
    shares = share(found.tested, against)
    rejected = {}
    for pair in fitting:
        a, b = (index[name] for name in pair)
        counts = [(against[i, j], found.tested[i, j]) for i, j in ((a, b), (b, a))]
        least, tested = min(counts)
        if shares[a, b] > MAX_CONTRADICTED and least >= CHECK.least_contradicted:
            rejected[pair] = Contradiction(
                images=[pair[0]], others=[pair[1]], tested=int(tested), contradicted=int(least)
            )
    return rejected


def _named(grouping: Grouping, names: list[str]) -> list[Contradiction]:
    """The contradictions with the names of the photos."""
    return [
        Contradiction(
            images=sorted(names[k] for k in each.groups[0]),
            others=sorted(names[k] for k in each.groups[1]),
            tested=each.tested,
            contradicted=each.contradicted,
        )
        for each in grouping.contradictions
    ]


def pair_fits(
    model: Model, normal: np.ndarray, matches: Mapping[Pair, PairResult], pairs: Iterable[Pair]
) -> dict[Pair, float]:
    """The share of each pair's matches that the model explains.

    A match of two keypoints fits if the surface under one keypoint is projected to the other one,
    within `MATCH_ERROR_PX`. Unlike rotations and epipolar lines, this tells a step of one house to
    the left from a step of two houses to the right.

    Args:
      normal: float64 (points, 3), of the model's points.
      matches: original pixels.
      pairs: only these are looked at.

    Returns:
      the shares, for the pairs whose two images are in the model and that have enough matches on
      its surface.
    """
    index = {view.name: k for k, view in enumerate(model.views)}
    found = {}
    for pair in sorted(pairs):
        if not index.keys() >= set(pair):
            continue
        one, own = {pair: matches[pair]}, 0
        fitting = 0
        for name in pair:
            view = model.views[index[name]]
            xy, points = matched_points(view, model, normal, one)
            at, _ = view.project(points)
            own += len(xy)
            fitting += int((np.linalg.norm(at - xy, axis=1) < MATCH_ERROR_PX).sum())
        if own >= 2 * CHECK.least_matches:
            found[pair] = fitting / own
    return found


def median_depths(model: Model) -> np.ndarray:
    """For each view the median depth of its points, float64 (views,), world units; NaN without."""
    points, of = model.tracks.points, model.tracks.point
    return np.asarray(
        [
            np.median((points[of[rows]] - view.centre) @ view.rotation[2]) if len(rows) else np.nan
            for view, rows in zip(model.views, model.rows, strict=True)
        ],
        np.float64,
    )


def scale_drift(model: Model) -> list[str]:
    """The photos that see their points so much nearer than most that the scale of a part of the
    model has drifted, sorted by name; none if all photos see them at similar distances.

    The mapper joins the parts of a scene by the points that both show. Where these are few, the
    bundle adjustment can shrink one part, cameras and points together. Its reprojection errors stay
    as they are, and so do the rotations and directions of its pairs, so nothing in a photo
    contradicts it. But its photos then see their points much nearer than other photos do.
    """
    depths = median_depths(model)
    ahead = depths > 0  # not NaN either
    if not ahead.any():
        return []
    nearest, farthest = np.percentile(depths[ahead], (OUTER, 100 - OUTER))
    if farthest <= MOST_SPREAD * nearest:
        return []
    near = ahead & (MOST_SPREAD * depths < farthest)
    return sorted(model.views[k].name for k in np.flatnonzero(near))


def thinned(model: Model, *, per_view: int = POINTS_PER_VIEW) -> Model:
    """The model with at most `per_view` points per view and `MAX_POINTS` in all, and with at most
    `OBSERVED_PER_VIEW` observations and `TRIED_PER_VIEW` points to try per view, on average.

    They are taken evenly by index. So the time of a check does not grow with the density of photos.
    """
    rows = thinned_points(model, per_view=per_view)
    if len(rows) == len(model.tracks.points):
        return model
    return model.with_tracks(model.tracks.select_points(rows))


def thinned_points(model: Model, *, per_view: int = POINTS_PER_VIEW) -> np.ndarray:
    """The points that `thinned` takes, int, ascending."""
    count, views = len(model.tracks.points), len(model.views)
    observed = max(len(model.tracks.point), 1)
    enough = OBSERVED_PER_VIEW * views * count // observed
    most = min(per_view * views, MAX_POINTS, enough)
    if min(count, most) > TRIED_PER_VIEW:  # fewer points cannot be too many in any view
        most = min(most, int(TRIED_PER_VIEW * views / max(_views_of_a_point(model), 1.0)))
    return _evenly(count, most)


def _evenly(count: int, most: int) -> np.ndarray:
    """At most so many indices below `count`, int, ascending."""
    return np.arange(count) if count <= most else np.arange(most) * count // most


def _views_of_a_point(model: Model) -> float:
    """How many views may show a point on average: it lies inside of them, and they see it from the
    side from which it is observed."""
    few = model.tracks.select_points(_evenly(len(model.tracks.points), TRIED_POINTS))
    centres = np.asarray([view.centre for view in model.views])
    side = np.zeros((len(few.points), 3))
    np.add.at(side, few.point, _unit(centres[few.view] - few.points[few.point]))
    shown, side = 0, _unit(side)
    for view in model.views:
        xy, _ = view.project(few.points)
        facing = (_unit(view.centre - few.points) * side).sum(1) > FACING
        with np.errstate(invalid="ignore"):  # NaN behind the camera
            inside = ((xy > -0.5) & (xy < np.asarray(view.size) - 0.5)).all(1)
        shown += int((inside & facing).sum())
    return shown / max(len(few.points), 1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of unit length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
