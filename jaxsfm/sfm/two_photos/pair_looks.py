"""Two photos, matched with as many looks as they need: which ones, and whose matches count.

Most pairs are matched at the first look. A strong pair whose photos show the same differently is
looked at once more, as seen from one place. A weak pair is looked at again at other scales, then
enlarged, as seen from one place, and turned if that did not help. Unless a pair is strong or
hopeless, the planes of its strongest look are then looked at one by one.
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
from jaxsfm.sfm.two_photos.common_view import SIZE, SMALL_SIZE, affine_between, mapped, view_change
from jaxsfm.sfm.two_photos.further_looks import (
    at_other_scales,
    closer_look,
    looks_at_planes,
    proposals,
    turned,
)
from jaxsfm.sfm.two_photos.look import Look, look, moved, to_stored

ENOUGH = 400.0
"""After a first look with so much evidence, no other one is searched for
(docs/decisions/hard-pairs.md)."""
ENOUGH_SHARE, AT_LEAST = 0.2, 60.0
"""Nor after one in which so large a share of the matches agrees, and which has at least so much
evidence: small photos have too few cells for more. First looks of hard pairs have 2 to 13 %."""
STRONG, STRONG_SHARE = 1000.0, 0.5
"""The planes of a pair are not looked at if its first look has so much evidence, or if so large a
share of its matches agrees: it is matched well as it is."""
MOST_ENLARGED = 2.0
"""Small photos are described once more, enlarged so much, if no scale is sure. The preset `robust`
does so at the first look."""
HOPELESS = 15.0
"""The planes of a look with less evidence are not looked at: nothing is likely to come of it."""
SURE = 150.0
"""If a look has so much evidence, no other one is searched for. Otherwise the planes of all looks
are tried one after the other, and the photos are turned: rows of windows match upside down with an
evidence above 50 (docs/decisions/hard-pairs.md)."""
MOST_SCALED, MOST_TURNED = 1.5, 15.0
"""A strong pair is looked at once more, as seen from one place, if one photo shows things larger by
a greater factor, in any direction, or turned by more degrees (docs/decisions/hard-pairs.md)."""
CONFIRMED = 0.5
"""It counts if it has so large a share of the evidence of the first one: matches of photos that are
seen alike are nearer, even if the view has fewer cells than the photos."""
HALF_SURE, POWER = 233.0, 2.2
"""A pair with the evidence `HALF_SURE` is as probably right as wrong, and the odds grow with this
power of the evidence. Fitted to drawn pairs with known poses (docs/decisions/hard-pairs.md)."""


class TwoPhotos(NamedTuple):
    """The matches of two photos, and how sure they are."""

    result: PairResult
    """In pixels of the stored photos, as they were verified."""
    aligned: AlignedMatches
    """The same matches, moved to a fraction of a pixel where the photos allow it."""
    evidence: float
    """That of the strongest look (`jaxsfm.sfm.two_photos.look.plane_evidence`)."""
    looks: int
    """How many looks were taken, the first one included."""

    @property
    def confidence(self) -> float:
        """The probability that the photos show the same and that most matches are right."""
        return confidence(self.evidence)


def confidence(evidence: float) -> float:
    """The probability that a pair with this evidence is right."""
    return 1 / (1 + (HALF_SURE / max(evidence, 1.0)) ** POWER)


def match_photos(
    weights: Weights,
    features0: ImageFeatures,
    features1: ImageFeatures,
    *,
    config: Config,
    seed: int = 0,
    worth_closer: float = 0.0,
) -> TwoPhotos:
    """Match two photos with as many looks as they need (`Config.closer_looks`).

    Args:
      features0, features1: the features of both photos, made with the same config.
      worth_closer: the evidence that the search for the scale must find, or no further look
        follows. The strongest photos of different places have 33 (docs/decisions/hard-pairs.md).

    Raises:
      ImageError: a photo cannot be decoded again.
    """
    images = (features0.image, features1.image)
    looks = looks_at_pair(
        weights, (features0, features1), config=config, seed=seed, worth_closer=worth_closer
    )
    aligned = [_aligned(each, images, config) for each in looks.chosen]
    return TwoPhotos(
        as_one([each.result for each in looks.chosen]),
        AlignedMatches(*map(np.concatenate, zip(*aligned, strict=True))),
        looks.evidence,
        looks.taken,
    )


def _aligned(best: Look, images: tuple[ImageFile, ImageFile], config: Config) -> AlignedMatches:
    """The matches of a look, aligned where they were seen alike."""
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
    return found._replace(keypoints1=mapped(back[1], found.keypoints1))


class PairLooks(NamedTuple):
    """The looks at a pair."""

    chosen: list[Look]
    """Those whose matches are the result."""
    taken: int
    """How many were taken."""

    @property
    def evidence(self) -> float:
        """That of the strongest look that counts."""
        return _best(self.chosen).evidence


def looks_at_pair(
    weights: Weights,
    features: tuple[ImageFeatures, ImageFeatures],
    *,
    config: Config,
    seed: int,
    worth_closer: float,
) -> PairLooks:
    """As many looks at two photos as they need (`Config.closer_looks`).

    Args:
      features: of both photos, made with the same config.
      worth_closer: the evidence that the search for the scale must find, or no further look
        follows.

    Raises:
      ImageError: a photo cannot be decoded again.
    """
    images = (features[0].image, features[1].image)
    first = look(*features, images, config=config, seed=seed)
    best, taken, least, settled = first, 1, HOPELESS, is_settled(first)
    if not config.closer_looks:
        return PairLooks([first], taken)
    if not settled:
        searched = [first, *at_other_scales(*features, config=config, seed=seed)]
        if _best(searched).evidence >= worth_closer:
            searched = _look_closer(weights, features, searched, config=config, seed=seed)
        best, taken, least = _best(searched), len(searched), max(HOPELESS, worth_closer)
    if best.evidence >= least and not is_strong(first):
        planes = looks_at_planes(weights, images, best, config=config, seed=seed)
        taken += planes.taken
        if planes.confirmed:
            return PairLooks(planes.confirmed, taken)
    if settled and not seen_alike(first, images):
        place = first.located(*images)
        nearer = closer_look(weights, images, place, size=SIZE, config=config, seed=seed)
        if nearer is not None:
            taken += 1
            if nearer.evidence >= CONFIRMED * first.evidence:
                best = nearer
    return PairLooks([best], taken)


def _look_closer(
    weights: Weights,
    features: tuple[ImageFeatures, ImageFeatures],
    looks: list[Look],
    *,
    config: Config,
    seed: int,
) -> list[Look]:
    """The looks that were taken, and further ones: enlarged, at proposals, and turned."""
    looks, images = list(looks), (features[0].image, features[1].image)
    if _best(looks).evidence < SURE and config.enlarge < MOST_ENLARGED:
        config = dataclasses.replace(config, enlarge=MOST_ENLARGED)
        enlarged0, enlarged1 = (image_features(weights, each, config=config) for each in images)
        looks.append(look(enlarged0, enlarged1, images, config=config, seed=seed))
        looks += at_other_scales(enlarged0, enlarged1, config=config, seed=seed)
        features = (enlarged0, enlarged1)
    if _best(looks).evidence < SURE:
        tried = (
            closer_look(weights, images, each, size=SMALL_SIZE, config=config, seed=seed)
            for each in proposals(looks, images)
        )
        looks += [each for each in tried if each is not None]
    if _best(looks).evidence < SURE:
        looks += turned(weights, features[0], images[1], config=config, seed=seed)
    return looks


def is_settled(first: Look) -> bool:
    """Whether a first look needs no other."""
    likely = first.evidence > AT_LEAST and _agreeing(first) >= ENOUGH_SHARE
    return likely or first.evidence >= ENOUGH


def is_strong(first: Look) -> bool:
    """Whether the matches of a first look need nothing more."""
    return is_settled(first) and (first.evidence >= STRONG or _agreeing(first) >= STRONG_SHARE)


def _agreeing(found: Look) -> float:
    """The share of the matches of a look that agree with a plane."""
    return found.result.num_inliers / max(found.result.num_tentative, 1)


def seen_alike(first: Look, images: tuple[ImageFile, ImageFile]) -> bool:
    """Whether both photos show what they share at nearly one scale, without much turn or slant."""
    affine = affine_between(first.located(*images))
    if affine is None:
        return True
    change = view_change(affine)
    return change.scale <= MOST_SCALED and change.turn <= MOST_TURNED


def _best(looks: list[Look]) -> Look:
    """The look with the most evidence; the earliest of equal ones."""
    return max(looks, key=lambda each: each.evidence)


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
