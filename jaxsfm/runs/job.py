"""A job: photos whose features and matches an engine computes and a store keeps."""

import dataclasses
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import TypeVar

from tqdm import tqdm

from jaxsfm.config import Config
from jaxsfm.io import interrupt
from jaxsfm.io.features import ImageFeatures, image_capacity
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.store import Store
from jaxsfm.io.weights import Weights
from jaxsfm.matching.engines import Engine, chosen_engine
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.extraction import image_features
from jaxsfm.options import LOCAL

T = TypeVar("T")


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
