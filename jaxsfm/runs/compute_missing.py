"""What a run's folder lacks of features and matches, computed and kept there as it is made."""

from collections.abc import Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm

from jaxsfm.config import Config
from jaxsfm.io import interrupt
from jaxsfm.io.features import ImageFeatures, image_capacity
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.weights import Weights
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.matching.engines import chosen_engine
from jaxsfm.matching.extraction import image_features
from jaxsfm.runs.run_options import RunOptions

T = TypeVar("T")


def extract_missing(
    folder: WorkFolder,
    weights: Weights,
    images: dict[str, ImageFile],
    pairs: list[Pair],
    config: Config,
    options: RunOptions,
) -> dict[str, str]:
    """Features of every image of `pairs` that has none yet; why some have none."""
    needed = sorted({name for pair in pairs for name in pair})
    todo = [images[name] for name in needed if not folder.has_features(images[name])]
    skipped: dict[str, str] = {}
    if not todo:
        return skipped
    engine = chosen_engine(options.engine)
    stream = engine.extract_images(weights, todo, config=config, execution=options.execution)
    for image, found in _bar(stream, len(todo), "extraction", "image", options):
        if isinstance(found, ImageError):
            folder.record_failure(image, found)
            skipped[image.name] = str(found)
        else:
            folder.save_features(found)
    return skipped


def match_missing(
    folder: WorkFolder,
    weights: Weights,
    images: dict[str, ImageFile],
    pairs: list[Pair],
    config: Config,
    options: RunOptions,
) -> Iterator[PairResult]:
    """Matches of pairs, saved as they are made."""

    def load(name: str) -> ImageFeatures:
        found = folder.load_features(images[name])
        if found is None:  # damaged or deleted under us: it is only a cache
            found = image_features(weights, images[name], config=config)
            folder.save_features(found)
        return found

    capacities = {name: image_capacity(image, config=config) for name, image in images.items()}
    stream = chosen_engine(options.engine).match_pairs(
        load, capacities, pairs, config=config, seed=options.seed, execution=options.execution
    )
    for result in _bar(stream, len(pairs), "matching", "pair", options):
        folder.save_matches(result)
        yield result


def _bar(items: Iterable[T], total: int, stage: str, unit: str, options: RunOptions) -> Iterator[T]:
    quiet = not options.progress or not total
    yield from tqdm(items, total=total, desc=stage, unit=unit, disable=quiet)
    interrupt.check()
