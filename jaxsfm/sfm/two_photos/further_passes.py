"""Further passes over two photos: at other scales, turned, as seen from one place, and at each
plane.

The network knows neither scale nor rotation. Features are made at several sizes of a photo anyway,
so a photo that shows things twice as large is matched at half its size, without describing anything
again. Turned photos have to be described again; half the size is enough to see whether they match.

For a rectified pass both photos are described again as seen from one place. A weak pass may have a
true plane among false ones, or two passes may have different ones. So each plane is a proposal of
its own, and a pass at a small common view tells which of them is true: under a true geometry the
photos look alike and the significance grows, under a false one it goes.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.core.octaves import smaller
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.photos import PhotoView, read_view
from jaxsfm.matching.extraction import describe_pixels
from jaxsfm.sfm.two_photos.matching_pass import BY_CHANCE, MatchingPass, PhotoPair, match_once
from jaxsfm.sfm.two_photos.rectification import (
    SMALL_SIZE,
    Located,
    affine_between,
    rectified_views,
    transformed,
)

MOST_PROPOSALS = 5
"""So many proposals are matched, the strongest first."""
SAME = 0.1
"""Two affine maps that put the points of one of them closer than this share of their extent are one
proposal."""
SIZES = (SMALL_SIZE, 1000)
"""The longer side of the views of a plane, pixels. A large photo shows more in the larger view, and
a small one is seen better in the smaller view (docs/decisions/hard-pairs.md)."""
OCTAVES = ((0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1))
"""The octaves of the first and of the second photo that are matched: relative scales of 2, 1/2, 4
and 1/4, and 2 and 1/2 once more at half the size, where noise and another sensor disturb less."""
LEAST_CELLS = 3
"""Coarse cells along the shorter side: one window of the coarse-to-fine step."""
TURNED_SIZE = 800
"""The longer side of a turned photo, pixels."""
TURNED_OCTAVES = (0, 1, 2)
"""The octaves of the first photo that a turned second photo is matched with."""


def at_octave(features: ImageFeatures, octave: int, *, fine_stride: int) -> ImageFeatures:
    """The features of a photo whose working image is 1 / 2^`octave` times as large."""
    x, y = features.scale
    return features._replace(
        scale=(x * 2**octave, y * 2**octave),
        dense=smaller(features.dense, octave, fine_stride=fine_stride),
    )


def at_other_scales(
    pair: PhotoPair, features0: ImageFeatures, features1: ImageFeatures
) -> Iterator[MatchingPass]:
    """Looks at two photos at other relative scales; none if the features have a single octave."""
    for octave0, octave1 in OCTAVES:
        if max(octave0, octave1) >= pair.config.octaves:
            continue
        side0 = at_octave(features0, octave0, fine_stride=pair.config.fine_stride)
        side1 = at_octave(features1, octave1, fine_stride=pair.config.fine_stride)
        if all(min(side.dense.coarse_grid) >= LEAST_CELLS for side in (side0, side1)):
            yield match_once(pair, side0, side1)


def turned_view(image: ImageFile, quarters: int) -> PhotoView:
    """The whole upright photo after quarter turns clockwise, of at most `TURNED_SIZE`."""
    width, height = image.upright_size
    factor = min(TURNED_SIZE / max(width, height), 1.0)
    turns = np.eye(3)
    for _ in range(quarters % 4):  # (x, y) of a photo of `height` rows becomes (height - 1 - y, x)
        turns = np.asarray([[0, -1, height - 1], [1, 0, 0], [0, 0, 1.0]]) @ turns
        width, height = height, width
    shift = 0.5 * factor - 0.5
    zoom = np.asarray([[factor, 0, shift], [0, factor, shift], [0, 0, 1.0]])
    return PhotoView(zoom @ turns, (round(width * factor), round(height * factor)))


def turned(pair: PhotoPair, features0: ImageFeatures) -> Iterator[MatchingPass]:
    """Looks at two photos, the second one turned by one, two and three quarter turns."""
    for quarters in (1, 2, 3):
        view = turned_view(pair.images[1], quarters)
        seen = _describe_view(pair, 1, view)
        for octave in TURNED_OCTAVES[: pair.config.octaves]:
            side = at_octave(features0, octave, fine_stride=pair.config.fine_stride)
            if min(side.dense.coarse_grid) >= LEAST_CELLS:
                yield match_once(pair, side, seen, views=(None, view))


def _describe_view(pair: PhotoPair, side: int, view: PhotoView) -> ImageFeatures:
    """The features of a view of one of the photos; coordinates are those of the view."""
    image = pair.images[side]
    return describe_pixels(
        pair.weights, view.as_photo(image), read_view(image, view), config=pair.config
    )


def match_rectified(pair: PhotoPair, matches: Located, *, size: int) -> MatchingPass | None:
    """A pass over both photos as seen from one place; None if the matches determine no place.

    Args:
      size: the longer side of the common view, pixels.
    """
    views = rectified_views(matches, *pair.images, size=size)
    if views is None:
        return None
    seen0, seen1 = (_describe_view(pair, side, view) for side, view in enumerate(views))
    return match_once(pair, seen0, seen1, views=views)


def proposals(passes: Sequence[MatchingPass], images: tuple[ImageFile, ImageFile]) -> list[Located]:
    """The matches that may show the true geometry: of whole passes and of single planes.

    They are ordered by their significance, and those that lead to the same view are left out.
    """
    found: list[tuple[float, Located]] = []
    for each in passes:
        found.append((each.significance, each.located(*images)))
        found += [
            (float(significance), each.on_planes(np.asarray([plane]), *images))
            for plane, significance in enumerate(each.plane_significance)
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
    ours, theirs = transformed(affine, matches.xy0), transformed(other, matches.xy0)
    extent = float(np.ptp(ours, axis=0).max())
    return float(np.median(np.linalg.norm(ours - theirs, axis=1))) < SAME * extent


class PlanePasses(NamedTuple):
    """Looks at the planes of a pair."""

    confirmed: list[MatchingPass]
    """Those that count, the strongest first."""
    taken: int
    """How many were taken, those included that do not count."""


def match_planes_rectified(pair: PhotoPair, best: MatchingPass) -> PlanePasses:
    """A pass over each of the strongest planes of a pass, as seen from one place.

    A common view of the whole scene fits one plane at best: other surfaces are shifted, stretched
    and slanted in it. In a view that fits their own plane they look alike in both photos, and their
    matches are more and nearer. The epipolar geometry of a pair depends on matches of several
    planes.

    A pass counts if what its planes have beyond chance is as much as the plane that led to it had
    with chance, so it must grow a little: what is seen alike is confirmed, and a false plane goes.
    Such a plane is seen once more, larger, and the stronger pass counts. The passes find other
    planes nearby, too.

    None counts if none is as strong as the pass that led to them: under a true geometry at least
    one is (docs/decisions/hard-pairs.md).

    Args:
      best: the pass whose planes are matched, as many as `Config.max_rectified_planes` says.
    """
    most = pair.config.max_rectified_planes
    strongest = np.argsort(-best.plane_significance, kind="stable")[:most]
    found, taken = [], 0
    for plane in strongest[best.plane_significance[strongest] > BY_CHANCE]:
        place = best.on_planes(np.asarray([plane]), *pair.images)
        confirmed = []
        for size in SIZES:
            nearer = match_rectified(pair, place, size=size)
            taken += nearer is not None
            if nearer is None or nearer.significance < best.plane_significance[plane]:
                break
            confirmed.append(nearer)
        if confirmed:
            found.append(max(confirmed, key=lambda each: each.significance))
    found.sort(key=lambda each: -each.significance)
    counts = bool(found) and found[0].significance >= best.significance
    return PlanePasses(found if counts else [], taken)
