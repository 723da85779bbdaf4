"""How strongly matches speak for it that two photos show the same.

The number of inliers does not say it: a plane of thirty inliers can be true or chance. It depends
on how many matches were tried, how large the photos are and how near a match must be. The evidence
of a plane is -log10 of the expected number of such planes among matches that are placed at random.
So it can be compared between looks at different sizes of the photos.

Source: Moisan and Stival 2004, "A probabilistic criterion to detect rigid point matches between two
images and estimate the fundamental matrix"; here for homographies.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from jaxsfm.io.pairs import PairResult


class Described(NamedTuple):
    """The size at which a photo, or a view of it, was described."""

    rows: int
    """Of fine cells."""
    columns: int
    zoom: float
    """Working pixels per pixel of the photo."""


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
"""Planes with less evidence than this do not count. Matches are not placed at random: repeated
structure and neighbouring cells give false planes an evidence of up to 35 (photos of different
places, docs/decisions/hard-pairs.md)."""


def log10_choose(n: float, k: float) -> float:
    """log10 of the number of ways to choose k of n; n and k need not be whole."""
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)) / math.log(10)


def evidence_of_plane(members: float, candidates: float, chance: float) -> float:
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


def plane_evidence(
    result: PairResult,
    described: tuple[Described, Described],
    *,
    threshold_px: float,
    fine_stride: int,
) -> np.ndarray:
    """The evidence of each plane of a pair, float64 (p,).

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
    evidence = []
    for plane in range(len(result.homographies)):
        cells = result.cells[result.plane == plane]
        members = min(
            _coarse_cells(cells[:, 0], first.columns, larger[0]),
            _coarse_cells(cells[:, 1], second.columns, larger[1]),
            candidates,
        )
        evidence.append(evidence_of_plane(members, candidates, chance))
    return np.asarray(evidence, np.float64)


def total(evidence: np.ndarray) -> float:
    """The evidence of a pair: what its planes have beyond chance, added up."""
    return float(np.maximum(evidence - BY_CHANCE, 0.0).sum())
