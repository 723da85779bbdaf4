"""Matches of image pairs by each method, for `bench wxbs`."""

import functools
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.bench.methods import NAIVE, method_config
from jaxsfm.bench.naive import match_pairs_naively
from jaxsfm.bench.options import WxbsOptions
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import read_matches
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.config import BackboneName, Config
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.weights import Weights, chosen_weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.sfm.two_photos.pair_looks import match_photos

FEATURES = 8
"""How many images' features are held: those of two images for each of four methods."""


class Matches(NamedTuple):
    """The matches of one pair by one method with one seed."""

    xy0: np.ndarray
    """float64 (n, 2): original pixels, centre of the top-left pixel (0, 0)."""
    xy1: np.ndarray
    seconds: float
    """Time of extracting both images and of matching; the first image of a size also compiles."""
    evidence: float | None = None
    """How strongly the matches speak for the pair (`jaxsfm.sfm.two_photos`); None if the method
    does not say it."""


class Matcher:
    """Matches pairs of images.

    The features of an image are computed once for all its pairs and all methods that use the same
    features.
    """

    def __init__(self, options: WxbsOptions) -> None:
        self._options = options
        self._weights: dict[BackboneName, Weights] = {}
        self._extract = functools.lru_cache(maxsize=FEATURES)(self._timed_features)

    def match(self, image0: ImageFile, image1: ImageFile, method: str) -> list[Matches]:
        """The matches of a pair for each seed.

        Args:
          image0, image1: two images of one folder, called by their files' names.
          method: one of `jaxsfm.bench.methods.PAIR_METHODS`.
        """
        seeds = range(self._options.seeds)
        if method == "rootsift":
            start = time.monotonic()
            xy0, xy1 = _rootsift(image0, image1)
            taken = time.monotonic() - start
            return [Matches(xy0, xy1, taken)] * len(seeds)  # nothing is random
        config = method_config(method, max_size=self._options.max_size)
        if method == NAIVE:
            return [self._naive(image0, image1, config, seed) for seed in seeds]
        (features0, seconds0), (features1, seconds1) = (
            self._extract(image, config.extraction()) for image in (image0, image1)
        )
        results = []
        for seed in seeds:
            start = time.monotonic()
            weights = self._weights_of(config)
            found = match_photos(weights, features0, features1, config=config, seed=seed)
            taken = seconds0 + seconds1 + time.monotonic() - start
            xy0, xy1 = found.result.keypoints0.astype(np.float64), found.aligned.keypoints1
            results.append(Matches(xy0, xy1, taken, found.evidence))
        return results

    def _naive(self, image0: ImageFile, image1: ImageFile, config: Config, seed: int) -> Matches:
        start = time.monotonic()
        images = {image.name: image for image in (image0, image1)}
        weights = self._weights_of(config)
        pair = (image0.name, image1.name)
        (found,) = match_pairs_naively(weights, images, [pair], config=config, seed=seed)
        xy0, xy1 = (xy.astype(np.float64) for xy in (found.keypoints0, found.keypoints1))
        return Matches(xy0, xy1, time.monotonic() - start)

    def _weights_of(self, config: Config) -> Weights:
        if config.backbone not in self._weights:
            self._weights[config.backbone] = chosen_weights(self._options.network, config.backbone)
        return self._weights[config.backbone]

    def _timed_features(self, image: ImageFile, config: Config) -> tuple[ImageFeatures, float]:
        weights = self._weights_of(config)
        start = time.monotonic()
        features = image_features(weights, image, config=config)
        return features, time.monotonic() - start


def _rootsift(image0: ImageFile, image1: ImageFile) -> tuple[np.ndarray, np.ndarray]:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        database = Path(scratch) / "database.db"
        # A fundamental matrix needs eight matches.
        write_rootsift_database(
            database,
            image0.path.parent,
            [image0, image1],
            Cameras(),
            VerificationOptions(min_inliers=8),
        )
        return read_matches(database, (image0.name, image1.name), verified=False)
