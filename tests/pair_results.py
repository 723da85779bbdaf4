"""Results of pairs that were never matched, and a job that computes nothing."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from jaxsfm.config import preset
from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairCounts, PairResult


def counts(inliers: int, tentative: int = 100) -> PairCounts:
    return PairCounts(inliers, 1, tentative, 0, Status.VERIFIED)


def result(pair: tuple[str, str], matches: int = 5) -> PairResult:
    xy = np.arange(2 * matches, dtype=np.float32).reshape(-1, 2)
    return PairResult(
        pair=pair,
        cells=np.arange(2 * matches, dtype=np.int32).reshape(-1, 2),
        keypoints0=xy,
        keypoints1=xy + 1,
        plane=np.zeros(matches, np.int32),
        homographies=np.eye(3)[None],
        num_tentative=60,
        num_dropped=0,
        status=Status.VERIFIED,
    )


def job_and_images() -> tuple[Any, dict[str, ImageFile]]:
    images = {
        name: ImageFile(name=name, path=Path(name), size=(8, 8), sha256=name * 64)
        for name in "abcd"
    }
    job = SimpleNamespace(
        weights=None, config=preset("default"), seed=7, load_features=lambda image: None
    )
    return job, images
