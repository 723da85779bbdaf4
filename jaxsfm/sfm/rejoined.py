"""Models of parts of a scene, joined again where matches put them together and no photo objects.

Rounds of mapping only take pairs away. Some of these are right, and so are parts that no pair joins
any more. For every two models, the matches between them say which of their points are the same, and
so how one lies in the other: a similarity. There may be several, where parts repeat. Each is tried.
The joined model is adjusted and checked. It stays if photos of both models agree in it and none
contradict each other.

Source: Heinly, Dunn and Frahm 2014, "Correcting for duplicate scene structure in sparse 3D
reconstruction", merge parts in this way. They compare keypoints.
"""

import dataclasses
import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.mapper import MapOptions
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import MIN_VIEWS
from jaxsfm.sfm.check.pair_fit import MIN_FIT, pair_fits
from jaxsfm.sfm.checker import Checker, opened
from jaxsfm.sfm.evaluation import Similarity
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.robust_similarity import robust_similarity
from jaxsfm.sfm.told_apart import LOSS_PX

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")

MIN_MATCHES = 30
"""A similarity needs so many matches. COLMAP asks for as many before it registers an image."""
MAX_SIMILARITIES = 3
"""So many similarities of two models are tried."""
TOLERANCE = 0.05
"""Largest distance of the two points of a match, as a share of their median distance from the
cameras. Points are not refined yet, and where focal lengths were guessed, models are bent."""
SAME_PX = 0.5
"""A matched keypoint is that of an observation this near, working pixels. All pairs of a photo have
the same keypoints, so it is exactly there."""
FIRST_LOSS_PX = 20.0
"""Scale of the loss of the first adjustment, working pixels: what was joined is far off."""

WithPoints = Callable[["pycolmap.Reconstruction", Collection[Pair]], "pycolmap.Reconstruction"]
"""Gives a model the points of the matches of some pairs."""


class Part(NamedTuple):
    """A model and its check."""

    model: "pycolmap.Reconstruction"
    done: Checked


class _Opened(NamedTuple):
    """A model with the points of all matches, as arrays."""

    model: Model

    def places(self) -> dict[str, int]:
        """The index of each view, by name."""
        return {view.name: k for k, view in enumerate(self.model.views)}

    def points_at(self, k: int, keypoints: np.ndarray) -> np.ndarray:
        """int (n,): the points that a view observes at keypoints, original pixels; -1: none."""
        tracks = self.model.tracks
        own = np.flatnonzero(tracks.view == k)
        if not len(own) or not len(keypoints):
            return np.full(len(keypoints), -1)
        at = self.model.views[k].pixels.from_original(keypoints)
        distance, nearest = map(np.asarray, KDTree(tracks.xy[own]).query(at))
        return np.where(distance <= SAME_PX, tracks.point[own[nearest]], -1)


def rejoined(
    parts: Sequence[Part], checker: Checker, with_points: WithPoints, options: MapOptions
) -> list[Part]:
    """Join models of three photos or more as often as possible.

    Args:
      parts: models in which no photos contradict each other.
      checker: has the matches and the photos, and checks joined models.
      with_points: for joined models.

    Returns:
      the models, the one with most photos first. Those that were not joined are the given ones.

    Raises:
      UserError: COLMAP failed.
    """
    left, tried = list(parts), set()
    while True:
        joined = next(_joins(left, tried, checker, with_points, options), None)
        if joined is None:
            break
        (one, other), part = joined
        logger.info("models of %d and %d photos were joined again", *map(_photos, (one, other)))
        left = [each for each in left if each is not one and each is not other] + [part]
    return sorted(left, key=lambda part: -_photos(part))


def _photos(part: Part) -> int:
    return part.model.num_reg_images()


def _joins(
    parts: Sequence[Part],
    tried: set[frozenset[str]],
    checker: Checker,
    with_points: WithPoints,
    options: MapOptions,
) -> Iterator[tuple[tuple[Part, Part], Part]]:
    """Two parts and what they become, those first between which there are most matches.

    Args:
      tried: the photos of what was tried before, which is added to.
    """
    given = checker.given
    whole = [part for part in parts if _photos(part) >= MIN_VIEWS]
    arrays = [_open(checker, part) for part in whole]
    ways = []
    for i, one in enumerate(arrays):
        for j in range(i):
            ways.append((i, j, _same_points(one, arrays[j], given.matches, given.two_views)))
    for i, j, same in sorted(ways, key=lambda way: (-len(way[2]), *way[:2])):
        names = frozenset({*arrays[i].places(), *arrays[j].places()})
        if len(same) < MIN_MATCHES or names in tried:
            continue
        tried.add(names)
        for way in _similarities(arrays[i].model, arrays[j].model, same, options.seed):
            part = _joined(arrays[i], arrays[j], way, checker, with_points, options)
            if part is not None:
                yield (whole[i], whole[j]), part


def _open(checker: Checker, part: Part) -> _Opened:
    return _Opened(opened(checker.with_all_points(part.model), checker.given.photos)[0])


def _same_points(
    one: _Opened,
    other: _Opened,
    matches: Mapping[Pair, PairResult],
    pairs: Collection[Pair],
) -> np.ndarray:
    """int (n, 2): points of one model and of the other one whose keypoints are matched.

    Pairs with a photo that both models have are left out: they say where this photo is.
    """
    index, others = one.places(), other.places()
    found = [np.zeros((0, 2), np.int64)]
    for pair in sorted(pairs):
        for swapped in (False, True):
            a, b = pair[::-1] if swapped else pair
            if a not in index or b not in others or a in others or b in index:
                continue
            result = matches[pair]
            sides = (result.keypoints0, result.keypoints1)[:: -1 if swapped else 1]
            points = np.stack(
                [one.points_at(index[a], sides[0]), other.points_at(others[b], sides[1])], axis=1
            )
            found.append(points[(points >= 0).all(1)])
    return np.unique(np.concatenate(found), axis=0)


class _Way(NamedTuple):
    """How one model lies in another one."""

    similarity: Similarity
    same: np.ndarray
    """int (n, 2): the points of the first model and of the other one that agree with it."""


def _similarities(one: Model, other: Model, same: np.ndarray, seed: int) -> Iterator[_Way]:
    """How the other model lies in the first one, the way with most points first.

    Args:
      same: int (n, 2), points of the two models that are matched.
    """
    tracks = one.tracks
    centres = np.asarray([view.centre for view in one.views])
    away = np.linalg.norm(tracks.points[tracks.point] - centres[tracks.view], axis=1)
    limit = TOLERANCE * float(np.median(away))
    for _ in range(MAX_SIMILARITIES):
        if len(same) < MIN_MATCHES:
            return
        source, target = other.tracks.points[same[:, 1]], tracks.points[same[:, 0]]
        found = robust_similarity(source, target, max_error=limit, seed=seed)
        if found.inliers.sum() < MIN_MATCHES:
            return
        yield _Way(found.similarity, same[found.inliers])
        same = same[~found.inliers]


def _together(one: Model, other: Model, way: _Way) -> Model:
    """Both models in the frame of the first one, with the points that they share joined.

    Views that both have stay where the first has them, without what the second has seen there.
    """
    own = {view.name for view in one.views}
    new, rows = other.part({view.name for view in other.views} - own)
    views = []
    for view in new.views:
        pose = way.similarity.moved(CameraPose(view.rotation, view.centre))
        views.append(dataclasses.replace(view, rotation=pose.rotation, centre=pose.centre))
    place = np.arange(len(rows)) + len(one.tracks.points)
    shared = np.full(len(other.tracks.points), -1)
    shared[way.same[:, 1]] = way.same[:, 0]
    place = np.where(shared[rows] >= 0, shared[rows], place)
    tracks = Tracks(
        np.concatenate([one.tracks.points, way.similarity.apply(new.tracks.points)]),
        np.concatenate([one.tracks.point, place[new.tracks.point]]),
        np.concatenate([one.tracks.view, new.tracks.view + len(one.views)]),
        np.concatenate([one.tracks.xy, new.tracks.xy]),
    )
    # Two points of the second model may be one of the first, which keeps one keypoint for a view.
    _, once = np.unique(
        tracks.point * (len(one.views) + len(views)) + tracks.view, return_index=True
    )
    tracks = tracks.select(np.sort(once))
    return Model([*one.views, *views], tracks, {**new.cameras, **one.cameras})


def _joined(
    one: _Opened,
    other: _Opened,
    way: _Way,
    checker: Checker,
    with_points: WithPoints,
    options: MapOptions,
) -> Part | None:
    """Two models as one; None if its photos do not agree, or if they say nothing."""
    both = _together(one.model, other.model, way)
    new = {view.name for view in both.views[len(one.model.views) :]}
    old = one.places().keys() - other.places().keys()
    sizes = {view.name: (view.size, view.pixels.scale) for view in both.views}

    def adjusted(model: "pycolmap.Reconstruction", loss_px: float) -> "pycolmap.Reconstruction":
        bundle_adjust(
            model,
            loss_px=loss_px * options.scale,
            refine_intrinsics=options.refine_intrinsics,
            threads=options.threads,
        )
        return model

    model = adjusted(both.to_colmap(), FIRST_LOSS_PX)
    agreeing = _agreeing_pairs(Model.from_colmap(model, sizes), checker)
    if not any(set(pair) & new and set(pair) & old for pair in agreeing):
        return None
    model = adjusted(with_points(model, agreeing), LOSS_PX)
    (done,) = checker.check([model], ())
    if done is None or done.check.contradictions:
        return None
    # A photo that both models have agrees with either, wherever the other one is.
    if not any(set(group) & new and set(group) & old for group in done.check.groups):
        return None
    return Part(model, done)


def _agreeing_pairs(model: Model, checker: Checker) -> set[Pair]:
    """The verified pairs that agree with a model."""
    neighbours = checker.refinement().neighbours
    normal = plane_geometry.normals(model, neighbours=neighbours)
    fits = pair_fits(model, normal, checker.given.matches, checker.given.two_views.keys())
    return {pair for pair, fit in fits.items() if fit >= MIN_FIT}
