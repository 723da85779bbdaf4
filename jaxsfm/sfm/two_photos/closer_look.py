"""Closer looks: both photos are described again as seen from one place.

A weak look may have a true plane among false ones, or two looks may have different ones. So each
plane is a proposal of its own, and a look at a small common view tells which of them is true: under
a true geometry the photos look alike and the evidence grows, under a false one it goes.
"""

from collections.abc import Sequence

import numpy as np

from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile
from jaxsfm.io.weights import Weights
from jaxsfm.sfm.two_photos.common_view import Located, affine_between, common_views, mapped
from jaxsfm.sfm.two_photos.look import Look, look
from jaxsfm.sfm.two_photos.scale_search import describe_view

MOST_PROPOSALS = 5
"""So many proposals are looked at, the strongest first."""
SAME = 0.1
"""Two affine maps that put the points of one of them closer than this share of their extent are one
proposal."""


def closer_look(
    weights: Weights,
    images: tuple[ImageFile, ImageFile],
    matches: Located,
    *,
    size: int,
    config: Config,
    seed: int,
) -> Look | None:
    """A look at both photos as seen from one place; None if the matches determine no place.

    Args:
      size: the longer side of the common view, pixels.
    """
    views = common_views(matches, *images, size=size)
    if views is None:
        return None
    seen0, seen1 = (
        describe_view(weights, image, view, config=config)
        for image, view in zip(images, views, strict=True)
    )
    return look(seen0, seen1, images, views=views, config=config, seed=seed)


def proposals(looks: Sequence[Look], images: tuple[ImageFile, ImageFile]) -> list[Located]:
    """The matches that may show the true geometry: of whole looks and of single planes.

    They are ordered by their evidence, and those that lead to the same view are left out.
    """
    found: list[tuple[float, Located]] = []
    for each in looks:
        found.append((each.evidence, each.located(*images)))
        found += [
            (float(evidence), each.on_planes(np.asarray([plane]), *images))
            for plane, evidence in enumerate(each.plane_evidence)
        ]
    chosen: list[tuple[Located, np.ndarray]] = []
    for _, matches in sorted(found, key=lambda item: -item[0]):
        affine = affine_between(matches)
        if affine is None or any(_same(matches, affine, other) for _, other in chosen):
            continue
        chosen.append((matches, affine))
        if len(chosen) == MOST_PROPOSALS:
            break
    return [matches for matches, _ in chosen]


def _same(matches: Located, affine: np.ndarray, other: np.ndarray) -> bool:
    """Whether two affine maps lead to nearly the same view of the matches."""
    ours, theirs = mapped(affine, matches.xy0), mapped(other, matches.xy0)
    extent = float(np.ptp(ours, axis=0).max())
    return float(np.median(np.linalg.norm(ours - theirs, axis=1))) < SAME * extent
