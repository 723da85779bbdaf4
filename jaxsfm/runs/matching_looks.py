"""The matching of a run's photos, at a small size first."""

import dataclasses
import logging
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

from jaxsfm.config import WORTH, Config
from jaxsfm.io.images import ImageFile, working_size
from jaxsfm.io.pairs import Pair, PairCounts, best_pairs
from jaxsfm.io.store import Store
from jaxsfm.report.run_inputs import RunIdentity
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.job import Job, images_of, pairs_without

logger = logging.getLogger("jaxsfm")


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the time of the block to that of a stage."""
    start = time.monotonic()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.monotonic() - start


class MatchedPairs(NamedTuple):
    """The pairs of a run that were matched at one size."""

    store: Store
    """Where the matches are."""
    described: Config
    """The settings that the photos were described with."""
    counts: dict[Pair, PairCounts]
    """Of every pair that was tried."""

    def with_inliers(self, n: int | None) -> list[Pair]:
        """The pairs with inliers, sorted; with `n`, only the best `n` pairs of each image."""
        counts = {pair: result.num_inliers for pair, result in self.counts.items()}
        if n is None:
            return sorted(pair for pair, count in counts.items() if count)
        return sorted(best_pairs(counts, n))


def first_look(config: Config, images: Collection[ImageFile]) -> Config | None:
    """The settings of the first look; None if it would hardly be smaller than the second one."""

    def median(at: Config) -> int:
        sides = sorted(max(working_size(each.size, at.max_size, at.enlarge)) for each in images)
        return sides[len(sides) // 2]

    if not images:
        return None
    full = median(config)
    first = config.of_first_look(full)
    return first if full / median(first) >= WORTH else None


def job_of_look(job: Job, identity: RunIdentity, config: Config) -> Job:
    """The same job with the settings of a look."""
    identity = dataclasses.replace(identity, config=config.matching())
    store = Store(job.store.path, to_json(identity))
    return dataclasses.replace(job, config=config, store=store)


def match_pairs(
    job: Job,
    by_name: Mapping[str, ImageFile],
    pairs: Collection[Pair],
    seconds: dict[str, float],
) -> tuple[dict[Pair, PairCounts], dict[str, str]]:
    """Match the pairs whose matches the job's store lacks.

    Returns:
      the counts of all pairs whose photos can be decoded; why other photos cannot, by name.
    """
    store = job.store
    with timed(seconds, "extraction"):
        before = {p: r.counts for p in pairs if (r := store.load_matches(p)) is not None}
        missing = [pair for pair in pairs if pair not in before]
        if before and job.progress:  # a trial of a few pairs is no news
            logger.info("%d of %d pairs have been matched before", len(before), len(pairs))
        lost = job.extract_missing(images_of(missing, by_name))
        counts = {pair: before[pair] for pair in pairs_without(before, lost)}
    with timed(seconds, "matching"):
        for result in job.match_missing(by_name, pairs_without(missing, lost)):
            counts[result.pair] = result.counts
    return counts, lost
