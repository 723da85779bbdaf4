"""Two photos, matched with as many looks as they need, and how sure their matches are."""

from typing import NamedTuple

import numpy as np

from jaxsfm.config import Config
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.photos import intensities, read_view
from jaxsfm.io.weights import Weights
from jaxsfm.sfm.refine.pair_alignment import AlignedMatches, align, align_matches
from jaxsfm.sfm.two_photos.common_view import mapped
from jaxsfm.sfm.two_photos.look import Look, moved, to_stored
from jaxsfm.sfm.two_photos.pair_looks import looks_at_pair
from jaxsfm.sfm.two_photos.plane_looks import as_one

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
    """`jaxsfm.sfm.two_photos.evidence`."""
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
