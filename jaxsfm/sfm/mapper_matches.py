"""The share of the verified matches that the mapper is given.

Dense features give thousands of matches for a pair, and poses need a few hundred. The mapper's time
grows with the number of matches, so it gets a part of them, and all others become points when the
model is there (`jaxsfm.colmap.mapper`). Pairs with few matches keep all of them.

A pair's matches are taken from all parts of both images, the best ones first. A match is good if
other images confirm it: if both keypoints are matched with the same keypoint of a third image.
"""

from collections import Counter
from collections.abc import Sequence
from typing import cast

import numpy as np
from scipy.sparse import csr_array

from jaxsfm.colmap.two_views import ImageKeypoints, Inliers
from jaxsfm.io.pairs import Pair

PER_PAIR, LEAST_PER_PAIR = 400, 100
"""At least so many matches of a pair are kept, if it has them: the first number, or fewer if both
images are in many pairs, but not fewer than the second number. COLMAP starts from a pair with 100
inliers."""
PER_IMAGE = 4000
"""The pairs of an image share so many matches."""
GRID = 16
"""Each image is divided into so many cells in either direction, and all cells of a pair are served
in turn."""


BLOCK = 50_000
"""So many keypoints are looked at together. A keypoint that 50 photos show takes about 1 kB."""


class _Rows:
    """All matches as rows of arrays, with keypoints numbered over all images."""

    def __init__(self, inliers: Inliers) -> None:
        names = sorted(inliers.keypoints)
        counts = [len(inliers.keypoints[name].xy) for name in names]
        first = dict(zip(names, np.cumsum([0, *counts[:-1]]), strict=True))
        self.pairs: list[Pair] = sorted(inliers.matches)
        self.keypoints = sum(counts)
        rows = [inliers.matches[pair] for pair in self.pairs]
        self.pair = np.repeat(np.arange(len(rows)), [len(each) for each in rows])
        self.ends = np.concatenate(
            [each + [first[a], first[b]] for each, (a, b) in zip(rows, self.pairs, strict=True)]
            or [np.zeros((0, 2), np.int64)]
        )
        """int64 (m, 2): the keypoints of each match."""
        self.cell = np.concatenate([_cells(inliers.keypoints[name]) for name in names])
        """int (keypoints,): the cell of its image that each lies in."""


def _cells(image: ImageKeypoints) -> np.ndarray:
    at = np.floor((image.xy + 0.5) / np.asarray(image.size) * GRID).clip(0, GRID - 1)
    return (at @ [1, GRID]).astype(np.int64)


def quotas(pairs: Sequence[Pair]) -> np.ndarray:
    """int (pairs,): how many matches of each pair are kept at least. An image with few pairs needs
    more of each."""
    partners = Counter(name for pair in pairs for name in pair)
    fewest = np.asarray([min(partners[name] for name in pair) for pair in pairs], np.int64)
    return np.clip(PER_IMAGE // np.maximum(fewest, 1), LEAST_PER_PAIR, PER_PAIR)


def mapper_matches(inliers: Inliers) -> dict[Pair, np.ndarray]:
    """Choose the matches for the mapper. The order of images, pairs and matches has no effect.

    As many matches of each pair are chosen as `quotas` says, and those of other pairs that join the
    same keypoints.

    Returns:
      for each pair, int64 (k, 2), the rows of `Inliers.matches` that were chosen, in their order.
    """
    rows = _Rows(inliers)
    best_first = _best_first(rows)
    in_cell = [
        _rank_within(rows.pair * GRID**2 + rows.cell[rows.ends[:, side]], best_first)
        for side in (0, 1)
    ]
    in_turn = best_first[np.argsort(np.maximum(*in_cell)[best_first], kind="stable")]
    chosen = _rank_within(rows.pair, in_turn) < quotas(rows.pairs)[rows.pair]
    kept = np.zeros(rows.keypoints, bool)
    kept[rows.ends[chosen]] = True
    whole = kept[rows.ends[:, 0]] & kept[rows.ends[:, 1]]
    ends = np.cumsum([len(inliers.matches[pair]) for pair in rows.pairs])
    of_pairs = np.split(whole, ends)[:-1]
    return {
        pair: inliers.matches[pair][own] for pair, own in zip(rows.pairs, of_pairs, strict=True)
    }


def _best_first(rows: _Rows) -> np.ndarray:
    """The matches, those first that most third images confirm, then those of which the keypoints
    have most matches."""
    a, b = rows.ends.T
    both = np.concatenate([rows.ends, rows.ends[:, ::-1]]).T
    shape = (rows.keypoints, rows.keypoints)
    joined = csr_array((np.ones(both.shape[1], np.int32), both), shape=shape)
    triangles = np.zeros(len(a), np.int64)
    for start in range(0, rows.keypoints, BLOCK):
        own = joined[start : start + BLOCK]
        confirmed = cast(csr_array, own @ joined).multiply(own).tocsr()
        here = np.flatnonzero((a >= start) & (a < start + BLOCK))
        triangles[here] = np.asarray(confirmed[a[here] - start, b[here]]).ravel()
    degree = np.diff(joined.indptr)
    return np.lexsort((_mixed(b), _mixed(a), -(degree[a] + degree[b]), -triangles))


def _mixed(numbers: np.ndarray) -> np.ndarray:
    """A fixed shuffle of whole numbers. Keypoints are numbered from top to bottom, and among equals
    those at the top of a cell should not come first."""
    return (numbers * 2654435761) % 2**32


def _rank_within(group: np.ndarray, order: np.ndarray) -> np.ndarray:
    """int (m,): the place of each match among those of its group, in an order of all matches."""
    ordered = order[np.argsort(group[order], kind="stable")]
    sorted_group = group[ordered]
    starts = np.flatnonzero(np.r_[True, sorted_group[1:] != sorted_group[:-1]])
    sizes = np.diff(np.r_[starts, len(ordered)])
    rank = np.empty(len(order), np.int64)
    rank[ordered] = np.arange(len(ordered)) - np.repeat(starts, sizes)
    return rank
