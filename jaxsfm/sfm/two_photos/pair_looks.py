"""Which looks two photos need, and whose matches count.

Most pairs are matched at the first look. A strong pair whose photos show the same differently is
looked at once more, as seen from one place. A weak pair is looked at again at other scales, then
enlarged, as seen from one place, and turned if that did not help. Unless a pair is strong or
hopeless, the planes of its strongest look are then looked at one by one.
"""

import dataclasses
from typing import NamedTuple

from jaxsfm.config import Config
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.weights import Weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.sfm.two_photos.closer_look import closer_look, proposals
from jaxsfm.sfm.two_photos.common_view import SIZE, SMALL_SIZE, affine_between, view_change
from jaxsfm.sfm.two_photos.look import Look, look
from jaxsfm.sfm.two_photos.plane_looks import looks_at_planes
from jaxsfm.sfm.two_photos.scale_search import at_other_scales, turned

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
