"""Two photos, matched with as many passes as they need: which ones, and whose matches count.

Most pairs are matched at the first pass. A strong pair whose photos show the same differently is
matched once more, as seen from one place. A weak pair is matched again at other scales, then
enlarged, as seen from one place, and turned if that did not help. Unless a pair is strong or
hopeless, the planes of its strongest pass are then matched one by one.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.config import Config
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairResult, united
from jaxsfm.io.photos import intensities, read_view
from jaxsfm.io.weights import Weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.sfm.refine.pair_alignment import AlignedMatches, align, align_matches
from jaxsfm.sfm.two_photos.further_passes import (
    at_other_scales,
    match_planes_rectified,
    match_rectified,
    proposals,
    turned,
)
from jaxsfm.sfm.two_photos.matching_pass import (
    MatchingPass,
    PhotoPair,
    match_once,
    moved,
    to_stored,
)
from jaxsfm.sfm.two_photos.rectification import (
    SIZE,
    SMALL_SIZE,
    affine_between,
    transformed,
    view_change,
)

ENOUGH = 400.0
"""After a first pass with so much significance, no other one is searched for
(docs/decisions/hard-pairs.md)."""
ENOUGH_SHARE, AT_LEAST = 0.2, 60.0
"""Nor after one in which so large a share of the matches agrees, and which has at least so much
significance: small photos have too few cells for more. First passes of hard pairs have 2 to 13
%."""
STRONG, STRONG_SHARE = 1000.0, 0.5
"""The planes of a pair are not matched if its first pass has so much significance, or if so large a
share of its matches agrees: it is matched well as it is."""
MOST_ENLARGED = 2.0
"""Small photos are described once more, enlarged so much, if no scale is sure. The preset `robust`
does so at the first pass."""
HOPELESS = 15.0
"""The planes of a pass with less significance are not matched: nothing is likely to come of it."""
SURE = 150.0
"""If a pass has so much significance, no other one is searched for. Otherwise the planes of all
passes are tried one after the other, and the photos are turned: rows of windows match upside down
with a significance above 50 (docs/decisions/hard-pairs.md)."""
MOST_SCALED, MOST_TURNED = 1.5, 15.0
"""A strong pair is matched once more, as seen from one place, if one photo shows things larger by
a greater factor, in any direction, or turned by more degrees (docs/decisions/hard-pairs.md)."""
CONFIRMED = 0.5
"""It counts if it has so large a share of the significance of the first one: matches of photos that
are seen alike are nearer, even if the view has fewer cells than the photos."""
HALF_SURE, POWER = 233.0, 2.2
"""A pair with the significance `HALF_SURE` is as probably right as wrong, and the odds grow with
this power of the significance. Fitted to drawn pairs with known poses
(docs/decisions/hard-pairs.md)."""


class TwoPhotos(NamedTuple):
    """The matches of two photos, and how sure they are."""

    result: PairResult
    """In pixels of the stored photos, as they were verified."""
    aligned: AlignedMatches
    """The same matches, moved to a fraction of a pixel where the photos allow it."""
    significance: float
    """That of the strongest pass (`jaxsfm.sfm.two_photos.matching_pass.plane_significance`)."""
    passes: int
    """How many passes were taken, the first one included."""

    @property
    def confidence(self) -> float:
        """The probability that the photos show the same and that most matches are right."""
        return confidence(self.significance)


def confidence(significance: float) -> float:
    """The probability that a pair with this significance is right."""
    return 1 / (1 + (HALF_SURE / max(significance, 1.0)) ** POWER)


def match_photos(
    weights: Weights,
    features0: ImageFeatures,
    features1: ImageFeatures,
    *,
    config: Config,
    seed: int = 0,
    worth_further: float = 0.0,
) -> TwoPhotos:
    """Match two photos with as many passes as they need (`Config.max_rectified_planes`).

    Args:
      features0, features1: the features of both photos, made with the same config.
      worth_further: the significance that the search for the scale must find, or no further pass
        follows. The strongest photos of different places have 33 (docs/decisions/hard-pairs.md).

    Raises:
      ImageError: a photo cannot be decoded again.
    """
    pair = PhotoPair((features0.image, features1.image), weights, config, seed)
    passes = match_in_passes(pair, (features0, features1), worth_further=worth_further)
    aligned = [_aligned(each, pair.images, config) for each in passes.chosen]
    return TwoPhotos(
        as_one([each.result for each in passes.chosen]),
        AlignedMatches(*map(np.concatenate, zip(*aligned, strict=True))),
        passes.significance,
        passes.taken,
    )


def _aligned(
    best: MatchingPass, images: tuple[ImageFile, ImageFile], config: Config
) -> AlignedMatches:
    """The matches of a pass, aligned where they were seen alike."""
    if None in best.views or not config.aligned_octaves or not best.result.num_inliers:
        return align(best.result, *images, config=config)
    gray0, gray1 = (
        intensities(read_view(image, view))
        for image, view in zip(images, best.views, strict=True)
        if view is not None
    )
    back = to_stored(best.views, images)
    found = align_matches(
        moved(best.result, np.linalg.inv(back[0]), np.linalg.inv(back[1])),
        gray0,
        gray1,
        (1.0, 1.0),
        (1.0, 1.0),
        octaves=config.aligned_octaves,
        max_error_px=config.threshold_px,
    )
    return found._replace(keypoints1=transformed(back[1], found.keypoints1))


class PairPasses(NamedTuple):
    """The passes over a pair."""

    chosen: list[MatchingPass]
    """Those whose matches are the result."""
    taken: int
    """How many were taken."""

    @property
    def significance(self) -> float:
        """That of the strongest pass that counts."""
        return _best(self.chosen).significance


def match_in_passes(
    pair: PhotoPair, features: tuple[ImageFeatures, ImageFeatures], *, worth_further: float
) -> PairPasses:
    """As many passes over two photos as they need (`Config.max_rectified_planes`).

    Args:
      features: of both photos, made with the config of the pair.
      worth_further: the significance that the search for the scale must find, or no further pass
        follows.

    Raises:
      ImageError: a photo cannot be decoded again.
    """
    first = match_once(pair, *features)
    best, taken, least, conclusive = first, 1, HOPELESS, is_conclusive(first)
    if not pair.config.max_rectified_planes:
        return PairPasses([first], taken)
    if not conclusive:
        searched = [first, *at_other_scales(pair, *features)]
        if _best(searched).significance >= worth_further:
            searched = _search_further(pair, features, searched)
        best, taken, least = _best(searched), len(searched), max(HOPELESS, worth_further)
    if best.significance >= least and not is_strong(first):
        planes = match_planes_rectified(pair, best)
        taken += planes.taken
        if planes.confirmed:
            return PairPasses(planes.confirmed, taken)
    if conclusive and not seen_alike(first, pair.images):
        nearer = match_rectified(pair, first.located(*pair.images), size=SIZE)
        if nearer is not None:
            taken += 1
            if nearer.significance >= CONFIRMED * first.significance:
                best = nearer
    return PairPasses([best], taken)


def _search_further(
    pair: PhotoPair, features: tuple[ImageFeatures, ImageFeatures], passes: list[MatchingPass]
) -> list[MatchingPass]:
    """The passes that were taken, and further ones: enlarged, at proposals, and turned."""
    passes = list(passes)
    if _best(passes).significance < SURE and pair.config.enlarge < MOST_ENLARGED:
        pair = pair._replace(config=dataclasses.replace(pair.config, enlarge=MOST_ENLARGED))
        enlarged0, enlarged1 = (
            image_features(pair.weights, each, config=pair.config) for each in pair.images
        )
        features = (enlarged0, enlarged1)
        passes.append(match_once(pair, *features))
        passes += at_other_scales(pair, *features)
    if _best(passes).significance < SURE:
        tried = (
            match_rectified(pair, each, size=SMALL_SIZE) for each in proposals(passes, pair.images)
        )
        passes += [each for each in tried if each is not None]
    if _best(passes).significance < SURE:
        passes += turned(pair, features[0])
    return passes


def is_conclusive(first: MatchingPass) -> bool:
    """Whether a first pass needs no other."""
    likely = first.significance > AT_LEAST and _agreeing(first) >= ENOUGH_SHARE
    return likely or first.significance >= ENOUGH


def is_strong(first: MatchingPass) -> bool:
    """Whether the matches of a first pass need nothing more."""
    return is_conclusive(first) and (
        first.significance >= STRONG or _agreeing(first) >= STRONG_SHARE
    )


def _agreeing(found: MatchingPass) -> float:
    """The share of the matches of a pass that agree with a plane."""
    return found.result.num_inliers / max(found.result.num_tentative, 1)


def seen_alike(first: MatchingPass, images: tuple[ImageFile, ImageFile]) -> bool:
    """Whether both photos show what they share at nearly one scale, without much turn or slant."""
    affine = affine_between(first.located(*images))
    if affine is None:
        return True
    change = view_change(affine)
    return change.scale <= MOST_SCALED and change.turn <= MOST_TURNED


def _best(passes: list[MatchingPass]) -> MatchingPass:
    """The pass with the most significance; the earliest of equal ones."""
    return max(passes, key=lambda each: each.significance)


def as_one(results: Sequence[PairResult]) -> PairResult:
    """The matches of several passes, one after the other.

    Each pass has cells of its own, so their indices are made to differ. A point that several passes
    saw has several matches (`one_match_each`).
    """

    def both(before: PairResult, result: PairResult) -> PairResult:
        first = int(before.cells.max(initial=-1)) + 1
        return united(before, dataclasses.replace(result, cells=result.cells + np.int32(first)))

    return functools.reduce(both, results)


def one_match_each(result: PairResult, spacing: tuple[float, float]) -> PairResult:
    """At most one match in each square of either photo, the first one: a count of points.

    Args:
      result: the matches of several passes, the strongest pass first.
      spacing: the side of a square in the first and in the second photo, pixels.
    """
    keep = np.arange(result.num_inliers)
    for keypoints, side in zip((result.keypoints0, result.keypoints1), spacing, strict=True):
        squares = np.floor(keypoints[keep] / side)
        keep = keep[np.sort(np.unique(squares, axis=0, return_index=True)[1])]
    rows = ("cells", "keypoints0", "keypoints1", "plane")
    return dataclasses.replace(result, **{name: getattr(result, name)[keep] for name in rows})
