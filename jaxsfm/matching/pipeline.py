"""The stages from photos to matches, as functions that keep everything in memory.

`jaxsfm.run_folder` runs the same stages in a work folder, where results are kept.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

from tqdm import tqdm

from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageError, ImageFile, inspect_image
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photo_folder import find_images
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.extraction import extract_images
from jaxsfm.matching.pair_matching import match_pairs


def open_images(folder: Path, *, progress: bool = False) -> tuple[list[ImageFile], dict[str, str]]:
    """Find the images in a folder and its sub-folders, and read their headers.

    Returns:
      The usable images, and for each of the others the reason why it cannot be used, by its name.

    Raises:
      UserError: there is no such folder, or no image file in it.
    """
    images, lost = [], {}
    names = find_images(folder)
    for name in tqdm(names, desc="reading", unit="image", delay=2, disable=not progress):
        try:
            images.append(inspect_image(folder / name, name=name))
        except UserError as error:
            lost[name] = str(error)
    return images, lost


def extract(
    weights: Weights,
    images: Iterable[ImageFile],
    *,
    config: Config,
    execution: Execution | None = None,
) -> dict[str, ImageFeatures]:
    """Dense features of images, by their names. An image of 1536 x 1024 takes 25 MB of memory.

    Raises:
      ImageError: an image cannot be decoded.
    """
    features = {}
    for image, found in extract_images(weights, images, config=config, execution=execution):
        if isinstance(found, ImageError):
            raise found
        features[image.name] = found
    return features


def match(
    features: Mapping[str, ImageFeatures],
    pairs: Iterable[tuple[str, str]],
    *,
    config: Config,
    seed: int = 0,
    execution: Execution | None = None,
) -> dict[Pair, PairResult]:
    """Verified matches of pairs of images, by pair; in each pair the lesser name is first.

    A pair's result depends on the two images, the config and the seed, not on other pairs.
    """
    capacities = {name: each.capacity for name, each in features.items()}
    results = match_pairs(
        features.__getitem__, capacities, pairs, config=config, seed=seed, execution=execution
    )
    return {result.pair: result for result in results}
