"""One look at two photos: their matches, how strong they are, and how the photos were seen."""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxsfm.config import Config
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.photos import PhotoView
from jaxsfm.matching.pair_matching import match_features
from jaxsfm.sfm.two_photos.common_view import Located, mapped, upright
from jaxsfm.sfm.two_photos.evidence import BY_CHANCE, Described, plane_evidence, total

Views = tuple[PhotoView | None, PhotoView | None]
"""How both photos were seen; None stands for the whole photo."""
WHOLE: Views = (None, None)


class Look(NamedTuple):
    """The outcome of matching two photos once."""

    result: PairResult
    """In pixels of the stored photos."""
    plane_evidence: np.ndarray
    """float64 (p,): the evidence of each plane (`jaxsfm.sfm.two_photos.evidence`)."""
    views: Views = WHOLE

    @property
    def evidence(self) -> float:
        """The evidence of all planes."""
        return total(self.plane_evidence)

    def located(self, image0: ImageFile, image1: ImageFile) -> Located:
        """The matches of the planes that are stronger than chance, or else of the strongest one."""
        good = np.flatnonzero(self.plane_evidence > BY_CHANCE)
        if not len(good) and len(self.plane_evidence):
            good = np.asarray([self.plane_evidence.argmax()])
        return self.on_planes(good, image0, image1)

    def on_planes(self, planes: np.ndarray, image0: ImageFile, image1: ImageFile) -> Located:
        """The matches of some planes, which are given by their indices."""
        keep = np.isin(self.result.plane, planes)
        return Located(
            upright(self.result.keypoints0[keep], image0),
            upright(self.result.keypoints1[keep], image1),
        )


def moved(result: PairResult, matrix0: np.ndarray, matrix1: np.ndarray) -> PairResult:
    """Matches whose coordinates are mapped, in each photo by an affine matrix (3, 3)."""
    h = matrix1 @ result.homographies @ np.linalg.inv(matrix0)
    return dataclasses.replace(
        result,
        keypoints0=mapped(matrix0, result.keypoints0).astype(np.float32),
        keypoints1=mapped(matrix1, result.keypoints1).astype(np.float32),
        homographies=h / np.linalg.norm(h, axis=(1, 2), keepdims=True),
    )


def to_stored(views: Views, images: tuple[ImageFile, ImageFile]) -> tuple[np.ndarray, np.ndarray]:
    """For both photos the matrix (3, 3) from pixels of the view to those of the stored photo."""
    first, second = (
        np.eye(3) if view is None else np.linalg.inv(view.from_stored(image))
        for view, image in zip(views, images, strict=True)
    )
    return first, second


def look(
    features0: ImageFeatures,
    features1: ImageFeatures,
    images: tuple[ImageFile, ImageFile],
    *,
    views: Views = WHOLE,
    config: Config,
    seed: int,
) -> Look:
    """Match two photos.

    Args:
      features0, features1: of the photos, of their octaves, or of `views` of them.
      images: the photos.
    """
    found = match_features(features0, features1, config=config, seed=seed)
    described0, described1 = (
        Described(
            rows=int(features.dense.fine_grid[0]),
            columns=int(features.dense.fine_grid[1]),
            zoom=1 / float(np.mean(features.scale)) if view is None else view.zoom,
        )
        for features, view in zip((features0, features1), views, strict=True)
    )
    evidence = _evidence(found, (described0, described1), config)
    return Look(
        moved(found, *to_stored(views, images)) if views != WHOLE else found, evidence, views
    )


def _evidence(
    found: PairResult, described: tuple[Described, Described], config: Config
) -> np.ndarray:
    """The evidence of each plane, float64 (p,), with the limits of a config."""
    return plane_evidence(
        found, described, threshold_px=config.threshold_px, fine_stride=config.fine_stride
    )
