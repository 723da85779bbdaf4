"""Models of parts of a scene, joined again where matches put them together and no photo objects.

Rounds of mapping only take pairs away. Some of these are right, and so are parts that no pair joins
any more. For every two models, the matches between them say how one lies in the other: a
similarity. There may be several, where parts repeat. Each is tried. The joined model is adjusted
and checked. It stays if photos of both models agree in it and none contradict each other.

Source: Heinly, Dunn and Frahm 2014, "Correcting for duplicate scene structure in sparse 3D
reconstruction", merge parts in this way. They compare keypoints.
"""

import dataclasses
import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

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
from jaxsfm.sfm.refine.evidence import REACH_PX
from jaxsfm.sfm.robust_similarity import robust_similarity
from jaxsfm.sfm.told_apart import LOSS_PX

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")

MIN_MATCHES = 30
"""A similarity needs so many matches. COLMAP asks for as many before it registers an image."""
MAX_SIMILARITIES = 3
"""So many similarities of two models are tried."""
TOLERANCE = 0.03
"""Largest distance of the two points of a match, as a share of their median distance from the
cameras. Points are not refined yet, and their depths are off by a few percent."""

WithPoints = Callable[["pycolmap.Reconstruction", Collection[Pair]], "pycolmap.Reconstruction"]
"""Gives a model the points of the matches of some pairs."""


class Part(NamedTuple):
    """A model and its check."""

    model: "pycolmap.Reconstruction"
    done: Checked


class _Opened(NamedTuple):
    """A model as arrays, with the normals of its points."""

    model: Model
    normal: np.ndarray

    def places(self) -> dict[str, int]:
        """The index of each view, by name."""
        return {view.name: k for k, view in enumerate(self.model.views)}


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
            common = _common_points(one, arrays[j], given.matches, given.two_views.keys())
            ways.append((len(common[0]), i, j, common))
    for count, i, j, (here, there) in sorted(ways, key=lambda way: (-way[0], way[1], way[2])):
        names = frozenset({*arrays[i].places(), *arrays[j].places()})
        if count < MIN_MATCHES or names in tried:
            continue
        tried.add(names)
        for similarity in _similarities(arrays[i].model, here, there, options.seed):
            part = _joined(arrays[i], arrays[j], similarity, checker, with_points, options)
            if part is not None:
                yield (whole[i], whole[j]), part


def _open(checker: Checker, part: Part) -> _Opened:
    model, _ = opened(part.model, checker.given.photos)
    neighbours = checker.refinement().neighbours
    return _Opened(model, plane_geometry.normals(model, neighbours=neighbours))


def _common_points(
    one: _Opened, other: _Opened, matches: Mapping[Pair, PairResult], pairs: Collection[Pair]
) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of one model and of the other one that matches join."""
    index, others = one.places(), other.places()
    here, there = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for pair in sorted(pairs):
        for a, b, swapped in ((*pair, False), (*reversed(pair), True)):
            if a not in index or b not in others or a in others or b in index:
                continue
            result = matches[pair]
            sides = (result.keypoints0, result.keypoints1)
            near = []
            for part, k, xy in zip(
                (one, other), (index[a], others[b]), sides[:: -1 if swapped else 1], strict=True
            ):
                at = part.model.views[k].pixels.from_original(xy)
                near.append(
                    plane_geometry.under_pixels(part.model, part.normal, k, at, reach_px=REACH_PX)
                )
            _, rows, columns = np.intersect1d(near[0][1], near[1][1], return_indices=True)
            here.append(near[0][0][rows])
            there.append(near[1][0][columns])
    return np.concatenate(here), np.concatenate(there)


def _similarities(
    model: Model, here: np.ndarray, there: np.ndarray, seed: int
) -> Iterator[Similarity]:
    """How points (n, 3) lie on those of a model, the way with most of them first."""
    tracks = model.tracks
    centres = np.asarray([view.centre for view in model.views])
    away = np.linalg.norm(tracks.points[tracks.point] - centres[tracks.view], axis=1)
    limit = TOLERANCE * float(np.median(away))
    for _ in range(MAX_SIMILARITIES):
        if len(here) < MIN_MATCHES:
            return
        found = robust_similarity(there, here, max_error=limit, seed=seed)
        if found.inliers.sum() < MIN_MATCHES:
            return
        yield found.similarity
        here, there = here[~found.inliers], there[~found.inliers]


def _together(one: Model, other: Model, similarity: Similarity) -> Model:
    """Both models in the frame of the first one. Views that both have stay where the first has
    them, without what the second has seen there."""
    own = {view.name for view in one.views}
    new, _ = other.part({view.name for view in other.views} - own)
    views = []
    for view in new.views:
        pose = similarity.moved(CameraPose(view.rotation, view.centre))
        views.append(dataclasses.replace(view, rotation=pose.rotation, centre=pose.centre))
    tracks = Tracks(
        np.concatenate([one.tracks.points, similarity.apply(new.tracks.points)]),
        np.concatenate([one.tracks.point, new.tracks.point + len(one.tracks.points)]),
        np.concatenate([one.tracks.view, new.tracks.view + len(one.views)]),
        np.concatenate([one.tracks.xy, new.tracks.xy]),
    )
    return Model([*one.views, *views], tracks, {**new.cameras, **one.cameras})


def _joined(
    one: _Opened,
    other: _Opened,
    similarity: Similarity,
    checker: Checker,
    with_points: WithPoints,
    options: MapOptions,
) -> Part | None:
    """Two models as one; None if its photos do not agree, or if they say nothing."""
    both = _together(one.model, other.model, similarity)
    agreeing = _agreeing_pairs(both, checker)
    new = {view.name for view in both.views[len(one.model.views) :]}
    old = one.places().keys() - other.places().keys()
    if not any(len(set(pair) & new) == 1 for pair in agreeing):
        return None
    model = with_points(both.to_colmap(), agreeing)
    bundle_adjust(
        model,
        loss_px=LOSS_PX * options.scale,
        refine_intrinsics=options.refine_intrinsics,
        threads=options.threads,
    )
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
