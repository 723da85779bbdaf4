"""Matches of pairs of images by each method, for the benchmarks of two views."""

import functools
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsfm.bench.common import KEYPOINTS, PAIR_ABLATED, method_config
from jaxsfm.colmap.database import VerificationOptions, read_matches
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.config import BackboneName, Config
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.versions import package_versions
from jaxsfm.io.weights import Weights, chosen_weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.matching.pair_matching import match_features
from jaxsfm.options import WeightsChoice
from jaxsfm.sfm.refine.pair_alignment import align

PAIR_METHODS = (
    "rootsift",
    "paper",
    "paper-learned",
    *KEYPOINTS,
    "default",
    "robust",
    *PAIR_ABLATED,
)
FEATURES = 8
"""Features held: of two images, as four methods want them."""


class Matches(NamedTuple):
    """Matches of one pair by one method and seed."""

    xy0: np.ndarray
    """float64 (n, 2): original pixels, centre of the top-left pixel (0, 0)."""
    xy1: np.ndarray
    seconds: float
    """Extraction of both images and matching; with a new image size, compilation too."""


class Matcher:
    """Matches pairs; an image's features are computed once for all pairs and methods that share
    them."""

    def __init__(self, network: WeightsChoice) -> None:
        self._network = network
        self._weights: dict[BackboneName, Weights] = {}
        self._extract = functools.lru_cache(maxsize=FEATURES)(self._timed_features)

    def match(
        self,
        image0: ImageFile,
        image1: ImageFile,
        method: str,
        seeds: Sequence[int],
        *,
        max_size: int | None,
    ) -> list[Matches]:
        """One result per seed.

        Args:
          image0, image1: two images of one folder, called by their files' names.
          method: of PAIR_METHODS. rootsift: COLMAP's own features and its matcher with ratio test,
            before any geometry; the others verified by homographies, and aligned where the method
            does, as `jaxsfm match` gives them.
          max_size: longer side of the working images, pixels; None: the preset's.
        """
        if method == "rootsift":
            start = time.monotonic()
            xy0, xy1 = _rootsift(image0, image1)
            taken = time.monotonic() - start
            return [Matches(xy0, xy1, taken)] * len(seeds)  # nothing random in it
        config = method_config(method, max_size=max_size)
        (features0, seconds0), (features1, seconds1) = (
            self._extract(image, config.extraction()) for image in (image0, image1)
        )
        results = []
        for seed in seeds:
            start = time.monotonic()
            found = match_features(features0, features1, config=config, seed=seed)
            xy1, _ = align(found, image0, image1, config=config)
            taken = seconds0 + seconds1 + time.monotonic() - start
            results.append(Matches(found.keypoints0.astype(np.float64), xy1, taken))
        return results

    def _timed_features(self, image: ImageFile, config: Config) -> tuple[ImageFeatures, float]:
        if config.backbone not in self._weights:
            self._weights[config.backbone] = chosen_weights(self._network, config.backbone)
        start = time.monotonic()
        features = image_features(self._weights[config.backbone], image, config=config)
        return features, time.monotonic() - start


def _rootsift(image0: ImageFile, image1: ImageFile) -> tuple[np.ndarray, np.ndarray]:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        database = Path(scratch) / "database.db"
        # Below eight there is no fundamental matrix.
        write_rootsift_database(
            database,
            image0.path.parent,
            [image0, image1],
            None,
            VerificationOptions(min_inliers=8),
        )
        return read_matches(database, (image0.name, image1.name), verified=False)


def pair_figures(
    benchmark: str,
    rows: list[dict[str, Any]],
    means: dict[str, Any],
    seeds: int,
    max_size: int | None,
) -> dict[str, Any]:
    """The plain JSON of a benchmark of pairs."""
    return {
        "benchmark": benchmark,
        "versions": package_versions(),
        "seeds": seeds,
        "max_size": max_size,
        "rows": rows,
        "means": means,
    }
