"""A job: photos whose features and matches an engine computes and a store keeps, at one size.

A run matches its photos at a low resolution first (`low_resolution`).
"""

import dataclasses
import logging
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

from tqdm import tqdm

from jaxsfm.config import WORTH, Config
from jaxsfm.io import interrupt
from jaxsfm.io.features import ImageFeatures, image_capacity
from jaxsfm.io.images import ImageError, ImageFile, working_size
from jaxsfm.io.pairs import Pair, PairCounts, PairResult, best_pairs
from jaxsfm.io.store import Store
from jaxsfm.io.weights import Weights
from jaxsfm.matching.engines import Engine, chosen_engine
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.extraction import image_features
from jaxsfm.options import LOCAL
from jaxsfm.report.run_inputs import RunIdentity
from jaxsfm.report.typed_json import to_json

T = TypeVar("T")
logger = logging.getLogger("jaxsfm")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """What features and matches are computed with, and where they are kept.

    The store keeps each result as soon as it is there. So a job that was interrupted is continued
    by another one with the same store.
    """

    store: Store
    """The work folder of a run, or a temporary folder."""
    earlier: tuple[Store, ...] = ()
    """Other stores whose features are used as well; nothing is written there."""
    weights: Weights
    config: Config
    engine: Engine
    execution: Execution
    seed: int
    progress: bool = False
    """Whether progress bars are shown."""

    def here(self) -> "Job":
        """The same job in this process, without bars: for so few pairs that workers would take
        longer to start."""
        return dataclasses.replace(self, engine=chosen_engine(LOCAL), progress=False)

    def load_features(self, image: ImageFile) -> ImageFeatures | None:
        """The features of an image; None if no store has them."""
        for store in (self.store, *self.earlier):
            found = store.load_features(image)
            if found is not None:
                return found
        return None

    def extract_missing(self, images: Iterable[ImageFile]) -> dict[str, str]:
        """Extract the images whose features no store has; returns why others cannot be decoded, by
        name."""
        stores = (self.store, *self.earlier)
        todo = [i for i in images if not any(store.has_features(i) for store in stores)]
        lost: dict[str, str] = {}
        if not todo:
            return lost
        stream = self.engine.extract_images(
            self.weights, todo, config=self.config, execution=self.execution
        )
        for image, found in self._bar(stream, len(todo), "extraction", "image"):
            if isinstance(found, ImageError):
                self.store.record_failure(image, found)
                lost[image.name] = str(found)
            else:
                self.store.save_features(found)
        return lost

    def match_missing(
        self, images: Mapping[str, ImageFile], pairs: Collection[Pair]
    ) -> Iterator[PairResult]:
        """Match pairs; yields each result after the store has it.

        Args:
          images: at least the images of the pairs, by name.
          pairs: pairs without matches in the store.
        """

        def load(name: str) -> ImageFeatures:
            found = self.load_features(images[name])
            if found is None:  # the file was damaged or deleted since the extraction
                found = image_features(self.weights, images[name], config=self.config)
                self.store.save_features(found)
            return found

        capacities = {
            name: image_capacity(image, config=self.config) for name, image in images.items()
        }
        stream = self.engine.match_pairs(
            load, capacities, pairs, config=self.config, seed=self.seed, execution=self.execution
        )
        for result in self._bar(stream, len(pairs), "matching", "pair"):
            self.store.save_matches(result)
            yield result

    def _bar(self, items: Iterable[T], total: int, stage: str, unit: str) -> Iterator[T]:
        quiet = not self.progress or not total
        yield from tqdm(items, total=total, desc=stage, unit=unit, disable=quiet)
        interrupt.check()


def images_of(pairs: Iterable[Pair], images: Mapping[str, ImageFile]) -> list[ImageFile]:
    """The images of pairs, each once, in order of names."""
    return [images[name] for name in sorted({name for pair in pairs for name in pair})]


def pairs_without(pairs: Iterable[Pair], names: Collection[str]) -> list[Pair]:
    """The pairs that have none of the names."""
    return [pair for pair in pairs if pair[0] not in names and pair[1] not in names]


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


def low_resolution(config: Config, images: Collection[ImageFile]) -> Config | None:
    """The settings of low-resolution matching; None if it would hardly be smaller than full
    size."""

    def median(at: Config) -> int:
        sides = sorted(max(working_size(each.size, at.max_size, at.enlarge)) for each in images)
        return sides[len(sides) // 2]

    if not images:
        return None
    full = median(config)
    first = config.at_low_resolution(full)
    return first if full / median(first) >= WORTH else None


def job_at_size(job: Job, identity: RunIdentity, config: Config) -> Job:
    """The same job at the size of some settings."""
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
            logger.info("%d of %d pairs are matched already", len(before), len(pairs))
        lost = job.extract_missing(images_of(missing, by_name))
        counts = {pair: before[pair] for pair in pairs_without(before, lost)}
    with timed(seconds, "matching"):
        for result in job.match_missing(by_name, pairs_without(missing, lost)):
            counts[result.pair] = result.counts
    return counts, lost
