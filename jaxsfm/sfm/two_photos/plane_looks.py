"""Looks at each plane of two photos, and their matches as one.

A common view of the whole scene fits one plane at best: other surfaces are shifted, stretched and
slanted in it. In a view that fits their own plane they look alike in both photos, and their matches
are more and nearer. The epipolar geometry of a pair depends on matches of several planes.
"""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairResult, united
from jaxsfm.io.weights import Weights
from jaxsfm.sfm.two_photos.closer_look import closer_look
from jaxsfm.sfm.two_photos.evidence import BY_CHANCE
from jaxsfm.sfm.two_photos.look import Look

SIZES = (600, 1000)
"""The longer side of the views of a plane, pixels. A large photo shows more in the larger view, and
a small one is seen better in the smaller view (docs/decisions/hard-pairs.md)."""


def looks_at_planes(
    weights: Weights, images: tuple[ImageFile, ImageFile], best: Look, *, config: Config, seed: int
) -> list[Look]:
    """A look at each of the strongest planes of a look, as seen from one place.

    A look counts if it is as strong as the plane that led to it: what is seen alike is confirmed,
    and a false plane goes (`jaxsfm.sfm.two_photos.closer_look`). Such a plane is seen once more,
    larger, and the stronger look counts. The looks find other planes nearby, too.

    Args:
      best: the look whose planes are looked at, as many as `config.closer_looks` says.

    Returns:
      the looks that count; none if none of them is as strong as the look that led to them: under a
      true geometry at least one is (docs/decisions/hard-pairs.md).
    """
    strongest = np.argsort(-best.plane_evidence, kind="stable")[: config.closer_looks]
    found = []
    for plane in strongest[best.plane_evidence[strongest] > BY_CHANCE]:
        place = best.on_planes(np.asarray([plane]), *images)
        confirmed = []
        for size in SIZES:
            nearer = closer_look(weights, images, place, size=size, config=config, seed=seed)
            if nearer is None or nearer.evidence < best.plane_evidence[plane]:
                break
            confirmed.append(nearer)
        if confirmed:
            found.append(max(confirmed, key=lambda each: each.evidence))
    strongest_look = max((each.evidence for each in found), default=0.0)
    return found if strongest_look >= best.evidence else []


def as_one(results: Sequence[PairResult]) -> PairResult:
    """The matches of several looks, one after the other.

    Each look has cells of its own, so their indices are made to differ. A point that several looks
    saw has several matches.
    """

    def both(before: PairResult, result: PairResult) -> PairResult:
        first = int(before.cells.max(initial=-1)) + 1
        return united(before, dataclasses.replace(result, cells=result.cells + np.int32(first)))

    return functools.reduce(both, results)
