"""Looks at each plane of two photos, and their matches as one.

A common view of the whole scene fits one plane at best: other surfaces are shifted, stretched and
slanted in it. In a view that fits their own plane they look alike in both photos, and their matches
are more and nearer. The epipolar geometry of a pair depends on matches of several planes.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairResult, united
from jaxsfm.io.weights import Weights
from jaxsfm.sfm.two_photos.closer_look import closer_look
from jaxsfm.sfm.two_photos.common_view import SMALL_SIZE
from jaxsfm.sfm.two_photos.evidence import BY_CHANCE
from jaxsfm.sfm.two_photos.look import Look

SIZES = (SMALL_SIZE, 1000)
"""The longer side of the views of a plane, pixels. A large photo shows more in the larger view, and
a small one is seen better in the smaller view (docs/decisions/hard-pairs.md)."""


class PlaneLooks(NamedTuple):
    """Looks at the planes of a pair."""

    confirmed: list[Look]
    """Those that count, the strongest first."""
    taken: int
    """How many were taken, those included that do not count."""


def looks_at_planes(
    weights: Weights, images: tuple[ImageFile, ImageFile], best: Look, *, config: Config, seed: int
) -> PlaneLooks:
    """A look at each of the strongest planes of a look, as seen from one place.

    A look counts if what its planes have beyond chance is as much as the plane that led to it had
    with chance, so it must grow a little: what is seen alike is confirmed, and a false plane goes
    (`jaxsfm.sfm.two_photos.closer_look`). Such a plane is seen once more, larger, and the stronger
    look counts. The looks find other planes nearby, too.

    None counts if none is as strong as the look that led to them: under a true geometry at least
    one is (docs/decisions/hard-pairs.md).

    Args:
      best: the look whose planes are looked at, as many as `config.closer_looks` says.
    """
    strongest = np.argsort(-best.plane_evidence, kind="stable")[: config.closer_looks]
    found, taken = [], 0
    for plane in strongest[best.plane_evidence[strongest] > BY_CHANCE]:
        place = best.on_planes(np.asarray([plane]), *images)
        confirmed = []
        for size in SIZES:
            nearer = closer_look(weights, images, place, size=size, config=config, seed=seed)
            taken += nearer is not None
            if nearer is None or nearer.evidence < best.plane_evidence[plane]:
                break
            confirmed.append(nearer)
        if confirmed:
            found.append(max(confirmed, key=lambda each: each.evidence))
    found.sort(key=lambda each: -each.evidence)
    counts = bool(found) and found[0].evidence >= best.evidence
    return PlaneLooks(found if counts else [], taken)


def as_one(results: Sequence[PairResult]) -> PairResult:
    """The matches of several looks, one after the other.

    Each look has cells of its own, so their indices are made to differ. A point that several looks
    saw has several matches (`one_match_each`).
    """

    def both(before: PairResult, result: PairResult) -> PairResult:
        first = int(before.cells.max(initial=-1)) + 1
        return united(before, dataclasses.replace(result, cells=result.cells + np.int32(first)))

    return functools.reduce(both, results)


def one_match_each(result: PairResult, spacing: tuple[float, float]) -> PairResult:
    """At most one match in each square of either photo, the first one: a count of points.

    Args:
      result: the matches of several looks, the strongest look first.
      spacing: the side of a square in the first and in the second photo, pixels.
    """
    keep = np.arange(result.num_inliers)
    for keypoints, side in zip((result.keypoints0, result.keypoints1), spacing, strict=True):
        squares = np.floor(keypoints[keep] / side)
        keep = keep[np.sort(np.unique(squares, axis=0, return_index=True)[1])]
    rows = ("cells", "keypoints0", "keypoints1", "plane")
    return dataclasses.replace(result, **{name: getattr(result, name)[keep] for name in rows})
