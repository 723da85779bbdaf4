"""Further passes over photos that found no place by their first matches.

The strongest pairs of such a photo are matched again at other scales, turned, and as seen from one
place (`jaxsfm.sfm.two_photos`). Their matches say only where the photo may stand. Whether it stands
there is for alignment to say.
"""

import dataclasses
import functools
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from jaxsfm.core.types import Status
from jaxsfm.io import interrupt
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.pairs import Pair, PairCounts, PairResult
from jaxsfm.io.store import Store
from jaxsfm.matching.extraction import image_features
from jaxsfm.runs.job import Job
from jaxsfm.sfm.limits import REGISTER
from jaxsfm.sfm.two_photos.matching_pass import PhotoPair
from jaxsfm.sfm.two_photos.pair_passes import HOPELESS, as_one, match_in_passes, one_match_each

KEPT_FEATURES = REGISTER.partners + 1
"""Photos whose features are in memory: those of one photo and of its partners."""


def match_further(
    job: Job, images: Mapping[str, ImageFile], pairs: Iterable[Pair], *, store: Store | None = None
) -> dict[Pair, PairResult]:
    """Match pairs with as many passes as they need.

    Pairs that show no sign of a common part at any scale get no further pass.

    Args:
      job: its config says how many planes are matched, or that one pass has to do
        (`Config.max_rectified_planes`); its stores may have features.
      images: the photos of the pairs, by name.
      store: where the results are kept, so that an interrupted run need not match again.

    Returns:
      the matches of the pairs that are worth a try, original pixels. Pairs of photos that cannot
      be decoded are left out.
    """

    @functools.lru_cache(KEPT_FEATURES)
    def features(name: str) -> ImageFeatures:
        found = job.load_features(images[name])
        return found or image_features(job.weights, images[name], config=job.config)

    worth = {}
    for pair in pairs:
        interrupt.check()
        found = store.load_matches(pair) if store else None
        if found is None:
            try:
                found = _matched(job, (features(pair[0]), features(pair[1])))
            except ImageError:
                continue
            if store:
                store.save_matches(found)
        if found.num_inliers:
            worth[pair] = found
    return worth


def _matched(job: Job, features: tuple[ImageFeatures, ImageFeatures]) -> PairResult:
    """The matches of a pair, one for each fine cell; none if they are hardly ever right."""
    pair = PhotoPair((features[0].image, features[1].image), job.weights, job.config, job.seed)
    passes = match_in_passes(pair, features, worth_further=HOPELESS)
    found = as_one([each.result for each in passes.chosen])
    if passes.significance < REGISTER.significance:
        return without_matches(found)
    first, second = (job.config.fine_stride * float(np.mean(each.scale)) for each in features)
    return one_match_each(found, (first, second))


def without_matches(result: PairResult) -> PairResult:
    """The same pair, not verified."""
    rows = {name: getattr(result, name)[:0] for name in ("cells", "keypoints0", "keypoints1")}
    return dataclasses.replace(
        result,
        **rows,
        plane=result.plane[:0],
        homographies=result.homographies[:0],
        status=Status.NO_PLANE,
    )


def pairs_to_rematch(
    lost: Iterable[str],
    registered: Collection[str],
    counts: Mapping[Pair, PairCounts],
    *,
    least: int,
) -> list[Pair]:
    """The strongest pairs of photos without a place with photos that have one, photo by photo.

    Args:
      counts: of all pairs that were tried.
      least: pairs with fewer tentative matches are left out. Two photos of anything have hundreds,
        and a blank photo has none at any scale.
    """
    found = {}
    for name in sorted(lost):
        own = [
            pair
            for pair in closest_pairs(name, counts)
            if set(pair) - {name} <= set(registered) and counts[pair].num_tentative >= least
        ]
        found |= dict.fromkeys(own[: REGISTER.partners])
    return list(found)


def closest_pairs(name: str, counts: Mapping[Pair, PairCounts]) -> list[Pair]:
    """The pairs of a photo: those with most inliers first, then those with most tentative matches.

    Args:
      counts: of pairs that were tried.
    """
    return strongest_first([pair for pair in counts if name in pair], counts)


def strongest_first(pairs: Iterable[Pair], counts: Mapping[Pair, PairCounts]) -> list[Pair]:
    """Pairs, those with most inliers first, then those with most tentative matches."""
    return sorted(pairs, key=lambda p: (-counts[p].num_inliers, -counts[p].num_tentative, p))
