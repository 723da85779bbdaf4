"""The photos of a run, and how they are matched: the first two steps of the road."""

import dataclasses
import logging
from collections.abc import Collection, Mapping

from tqdm import tqdm

from jaxsfm.io.images import ImageFile, named
from jaxsfm.io.pairs import Pair, PairCounts, PairResult
from jaxsfm.io.store import Store
from jaxsfm.report.run_inputs import RunIdentity
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.closer_looks import closest_pairs, look_closer, pairs_to_look_at
from jaxsfm.runs.job import (
    Job,
    MatchedPairs,
    first_look,
    job_of_look,
    match_pairs,
    pairs_without,
)
from jaxsfm.runs.turned_photos import Trials, find_turned
from jaxsfm.sfm.limits import REGISTER

logger = logging.getLogger("jaxsfm")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunPhotos:
    """The photos of a run that can be decoded, and the pairs of them to match."""

    job: Job
    identity: RunIdentity
    images: Mapping[str, ImageFile]
    pairs: Collection[Pair]

    def match(self, seconds: dict[str, float]) -> tuple[MatchedPairs, dict[str, str]]:
        """Match the pairs at a small size; says also why photos cannot be decoded."""
        first = first_look(self.job.config, self.images.values())
        look = job_of_look(self.job, self.identity, first or self.job.config)
        counts, lost = match_pairs(look, self.images, self.pairs, seconds)
        return MatchedPairs(look.store, look.config, counts), lost

    def match_at_full_size(
        self, before: Mapping[Pair, PairCounts], seconds: dict[str, float]
    ) -> MatchedPairs:
        """Match each photo with its best partners at full size.

        Args:
          before: the counts of the pairs at a small size.
        """
        best = {
            pair
            for name in self.images
            for pair in closest_pairs(name, before)[: REGISTER.partners_without_model]
        }
        job = job_of_look(self.job, self.identity, self.job.config)
        counts, _ = match_pairs(job, self.images, sorted(best), seconds)
        return MatchedPairs(job.store, job.config, counts)

    def upright(
        self, matched: MatchedPairs, seconds: dict[str, float]
    ) -> tuple["RunPhotos", MatchedPairs]:
        """These photos with those turned that are stored sideways, and their matches."""
        trials = Trials(self.job, self.identity, self.images, seconds)
        turned = find_turned(trials, matched.counts)
        if not turned:
            return self, matched
        identity = self.identity.with_images(turned.values())
        job = job_of_look(self.job, identity, self.job.config)
        images = {**self.images, **turned}
        photos = dataclasses.replace(self, job=job, identity=identity, images=images)
        return photos, photos.match(seconds)[0]

    def without(self, lost: Collection[str]) -> "RunPhotos":
        """These photos without some."""
        left = {name: image for name, image in self.images.items() if name not in lost}
        return dataclasses.replace(self, images=left, pairs=pairs_without(self.pairs, lost))


@dataclasses.dataclass(frozen=True)
class LostMatcher:
    """Matches photos without a place with their best partners at full size: as they are, or as seen
    from one place (`jaxsfm.runs.closer_looks`)."""

    photos: RunPhotos
    counts: Mapping[Pair, PairCounts]
    """Of all pairs that were tried."""
    tried: set[tuple[Pair, bool]] = dataclasses.field(default_factory=set)
    """The pairs that were looked at, and whether closer. No pair is looked at twice alike."""

    def __call__(
        self,
        lost: Collection[str],
        placed: Collection[str],
        false: Collection[Pair],
        *,
        closer: bool,
    ) -> dict[Pair, PairResult]:
        """Matches of lost photos, original pixels (`jaxsfm.sfm.register.lost.MatchLost`)."""
        job, identity = self.photos.job, self.photos.identity
        config = job.config if closer else dataclasses.replace(job.config, closer_looks=0)
        counts = {pair: count for pair, count in self.counts.items() if pair not in false}
        pairs = pairs_to_look_at(lost, placed, counts, least=job.config.min_inliers)
        pairs = [pair for pair in pairs if (pair, closer) not in self.tried]
        if not pairs or (closer and not config.closer_looks):
            return {}
        self.tried.update((pair, closer) for pair in pairs)
        settings = {**config.matching(), "closer_looks": config.closer_looks}
        store = Store(job.store.path, to_json(dataclasses.replace(identity, config=settings)))
        sought = sorted({name for pair in pairs for name in pair} & set(lost))
        what = "closer looks" if closer else "full size"
        logger.info("no place yet, %s: %s", what, named(sought))
        bar = tqdm(pairs, desc=what, unit="pair", disable=not job.progress)
        full = job_of_look(job, identity, config)
        return look_closer(full, self.photos.images, bar, store=store)
