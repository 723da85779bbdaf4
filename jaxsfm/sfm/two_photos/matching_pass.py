"""One pass over two photos: their matches, how strong they are, and how the photos were seen."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from jaxsfm.config import Config
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.photos import PhotoView
from jaxsfm.io.weights import Weights
from jaxsfm.matching.pair_matching import match_features
from jaxsfm.sfm.two_photos.rectification import Located, transformed, upright

Views = tuple[PhotoView | None, PhotoView | None]
"""How both photos were seen; None stands for the whole photo."""
WHOLE: Views = (None, None)
MINIMAL = 4
"""The number of matches that determine a homography."""
MATCHES_OF_A_CELL = 4
"""About so many fine matches come from one coarse match and agree with each other by construction.
So they are counted once: by the coarse cells that they lie in."""
ENLARGED = 2.0
"""Neighbouring cells of a photo that is enlarged more than this see the same pixels, so they are
counted in larger cells. In a thermal photo that is enlarged four times, false matches agree with
their neighbours."""
BY_CHANCE = 15.0
"""Planes with less significance than this do not count. Matches are not placed at random: repeated
structure and neighbouring cells give false planes a significance of up to 35 (photos of different
places, docs/decisions/hard-pairs.md)."""


class PhotoPair(NamedTuple):
    """Two photos, and what all passes over them are made with."""

    images: tuple[ImageFile, ImageFile]
    weights: Weights
    config: Config
    seed: int
    """For RANSAC."""


class Described(NamedTuple):
    """The size at which a photo, or a view of it, was described."""

    rows: int
    """Of fine cells."""
    columns: int
    zoom: float
    """Working pixels per pixel of the photo."""


class MatchingPass(NamedTuple):
    """The outcome of matching two photos once."""

    result: PairResult
    """In pixels of the stored photos."""
    plane_significance: np.ndarray
    """float64 (p,): the significance of each plane (the function `plane_significance`)."""
    views: Views = WHOLE

    @property
    def significance(self) -> float:
        """The significance of all planes."""
        return total(self.plane_significance)

    def located(self, image0: ImageFile, image1: ImageFile) -> Located:
        """The matches of the planes that are stronger than chance, or else of the strongest one."""
        good = np.flatnonzero(self.plane_significance > BY_CHANCE)
        if not len(good) and len(self.plane_significance):
            good = np.asarray([self.plane_significance.argmax()])
        return self.on_planes(good, image0, image1)

    def on_planes(self, planes: np.ndarray, image0: ImageFile, image1: ImageFile) -> Located:
        """The matches of some planes, which are given by their indices."""
        keep = np.isin(self.result.plane, planes)
        return Located(
            upright(self.result.keypoints0[keep], image0),
            upright(self.result.keypoints1[keep], image1),
        )


def moved(result: PairResult, matrix0: np.ndarray, matrix1: np.ndarray) -> PairResult:
    """Matches whose coordinates are transformed, in each photo by an affine matrix (3, 3)."""
    h = matrix1 @ result.homographies @ np.linalg.inv(matrix0)
    return dataclasses.replace(
        result,
        keypoints0=transformed(matrix0, result.keypoints0).astype(np.float32),
        keypoints1=transformed(matrix1, result.keypoints1).astype(np.float32),
        homographies=h / np.linalg.norm(h, axis=(1, 2), keepdims=True),
    )


def to_stored(views: Views, images: tuple[ImageFile, ImageFile]) -> tuple[np.ndarray, np.ndarray]:
    """For both photos the matrix (3, 3) from pixels of the view to those of the stored photo."""
    first, second = (
        np.eye(3) if view is None else np.linalg.inv(view.from_stored(image))
        for view, image in zip(views, images, strict=True)
    )
    return first, second


def match_once(
    pair: PhotoPair,
    features0: ImageFeatures,
    features1: ImageFeatures,
    *,
    views: Views = WHOLE,
) -> MatchingPass:
    """Match two photos.

    Args:
      features0, features1: of the photos, of their octaves, or of `views` of them.
    """
    config = pair.config
    found = match_features(features0, features1, config=config, seed=pair.seed)
    described0, described1 = (
        Described(
            rows=int(features.dense.fine_grid[0]),
            columns=int(features.dense.fine_grid[1]),
            zoom=1 / float(np.mean(features.scale)) if view is None else view.zoom,
        )
        for features, view in zip((features0, features1), views, strict=True)
    )
    significance = plane_significance(
        found,
        (described0, described1),
        threshold_px=config.threshold_px,
        fine_stride=config.fine_stride,
    )
    return MatchingPass(
        moved(found, *to_stored(views, pair.images)) if views != WHOLE else found,
        significance,
        views,
    )


def log10_choose(n: float, k: float) -> float:
    """log10 of the number of ways to choose k of n; n and k need not be whole."""
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)) / math.log(10)


def neg_log10_nfa(members: float, candidates: float, chance: float) -> float:
    """-log10 of the expected number of planes with as many members among random matches.

    Args:
      members: the number of matches of the plane, those that determine it included.
      candidates: the number of all matches, at least `members`.
      chance: the probability that a random match lies near where a plane puts it, in (0, 1).
    """
    if members <= MINIMAL:
        return -math.inf
    tests = math.log10(candidates) + log10_choose(candidates, members)
    tests += log10_choose(members, MINIMAL)
    return -(tests + (members - MINIMAL) * math.log10(chance))


def _coarse_cells(cells: np.ndarray, columns: int, times: float) -> int:
    """The number of coarse cells that fine cells lie in; the coarse cells are `times` as large."""
    rows, cols = ((side / (2 * times)).astype(int) for side in (cells // columns, cells % columns))
    return len(np.unique(rows * columns + cols))


def plane_significance(
    result: PairResult,
    described: tuple[Described, Described],
    *,
    threshold_px: float,
    fine_stride: int,
) -> np.ndarray:
    """The significance of each plane of a pair, float64 (p,).

    It says how strongly the plane speaks for it that the two photos show the same. The number of
    inliers does not say it: a plane of thirty inliers can be true or chance. It depends on how many
    matches were tried, how large the photos are and how near a match must be. The significance of a
    plane is -log10 of the expected number of such planes among matches that are placed at random.
    So it can be compared between passes at different sizes of the photos.

    Source: Moisan and Stival 2004, "A probabilistic criterion to detect rigid point matches between
    two images and estimate the fundamental matrix"; here for homographies.

    Args:
      described: how the photos that were matched were described.
      threshold_px: the largest error of an inlier, working pixels of the second photo.
      fine_stride: the side of a fine cell, working pixels.
    """
    first, second = described
    area = second.rows * second.columns * fine_stride**2
    chance = min(math.pi * threshold_px**2 / area, 0.5)
    larger = [max(zoom / ENLARGED, 1.0) for zoom in (first.zoom, second.zoom)]
    candidates = max(result.num_tentative / MATCHES_OF_A_CELL / max(larger) ** 2, 10.0)
    significance = []
    for plane in range(len(result.homographies)):
        cells = result.cells[result.plane == plane]
        members = min(
            _coarse_cells(cells[:, 0], first.columns, larger[0]),
            _coarse_cells(cells[:, 1], second.columns, larger[1]),
            candidates,
        )
        significance.append(neg_log10_nfa(members, candidates, chance))
    return np.asarray(significance, np.float64)


def total(significance: np.ndarray) -> float:
    """The significance of a pair: what its planes have beyond chance, added up."""
    return float(np.maximum(significance - BY_CHANCE, 0.0).sum())
