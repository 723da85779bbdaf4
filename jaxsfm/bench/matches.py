"""Matches of pairs of images by each method, for the benchmarks of two views."""

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.bench.common import method_config
from jaxsfm.host.features import image_features
from jaxsfm.host.images import inspect_image
from jaxsfm.host.rootsift import read_matches, write_rootsift_database
from jaxsfm.host.weights import Weights, load_weights
from jaxsfm.pipeline import match_features, on_device

PAIR_METHODS = ("rootsift", "paper", "grid", "default", "robust")


class Matches(NamedTuple):
    """Matches of one pair by one method and seed."""

    xy0: np.ndarray
    """float64 (n, 2): original pixels, centre of the top-left pixel (0, 0)."""
    xy1: np.ndarray
    seconds: float
    """Extraction of both images and matching; with a new image size, compilation too."""


class Matcher:
    """Matches pairs; loads the weights once, when they are first needed."""

    def __init__(self) -> None:
        self._weights: Weights | None = None

    def match(
        self, path0: Path, path1: Path, method: str, seeds: Sequence[int], *, max_size: int | None
    ) -> list[Matches]:
        """One result per seed.

        Args:
          path0, path1: two images of one folder.
          method: of PAIR_METHODS. rootsift: COLMAP's own features and its matcher with ratio test,
            before any geometry; the others verified by homographies, as they leave our pipeline.
          max_size: longer side of the working images, pixels; None: the preset's.
        """
        if method == "rootsift":
            start = time.monotonic()
            xy0, xy1 = _rootsift(path0, path1)
            taken = time.monotonic() - start
            return [Matches(xy0, xy1, taken)] * len(seeds)  # nothing random in it
        return self._dense(path0, path1, method, seeds, max_size)

    def _dense(
        self, path0: Path, path1: Path, method: str, seeds: Sequence[int], max_size: int | None
    ) -> list[Matches]:
        config = method_config(method, max_size=max_size)
        if self._weights is None:
            self._weights = on_device(load_weights())
        start = time.monotonic()
        features = [
            image_features(self._weights, inspect_image(path, name=path.name), config=config)
            for path in (path0, path1)
        ]
        extraction = time.monotonic() - start
        results = []
        for seed in seeds:
            start = time.monotonic()
            found = match_features(features[0], features[1], config=config, seed=seed)
            taken = extraction + time.monotonic() - start
            results.append(
                Matches(
                    found.keypoints0.astype(np.float64), found.keypoints1.astype(np.float64), taken
                )
            )
        return results


def _rootsift(path0: Path, path1: Path) -> tuple[np.ndarray, np.ndarray]:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        database = Path(scratch) / "database.db"
        images = [inspect_image(path, name=path.name) for path in (path0, path1)]
        # Below eight there is no fundamental matrix.
        write_rootsift_database(
            database, path0.parent, images, None, seed=0, threads=-1, min_inliers=8
        )
        return read_matches(database, (path0.name, path1.name))
