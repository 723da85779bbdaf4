"""Reads the matches of detector-free matchers, in the layout in which hloc stores them (HDF5), and
gathers their points to keypoints that pairs share.

Detector-free matchers (LoFTR, RoMa, DKM) find new points in every pair, so a point of the scene has
about as many positions in a photo as the photo has pairs. Without common keypoints, all tracks have
two observations. Here the positions of a photo are gathered in cells.

Layout (hloc/match_dense.py): group NAME0/NAME1, each name's '/' turned into '-' (older files:
NAME0_NAME1), with `keypoints0` and `keypoints1` (n, 2), (x, y) of the original photos, centre of
the top-left pixel (0, 0), and `scores` (n,). hloc may have added `matches0` to the group, which is
not read.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxsfm.colmap.formats.hloc import DAMAGED, dataset, pairs_in
from jaxsfm.colmap.formats.tables import MAX_KEYPOINTS, Tables, checked_keypoints
from jaxsfm.errors import UserError
from jaxsfm.io.extras import extra
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, describe, make_pair

with extra("hdf5", "reading and writing HDF5 files needs"):
    import h5py

CELL_SHARE = 1 / 400
"""The side of a cell as a share of the photo's longer side: 4 pixels of 1600."""
BORDER_PX = 1.5
"""Keypoints may lie so far beyond the centres of the outermost pixels."""
LEAST_SCORE = 1e-6
"""Smaller scores count as this one, so that a cell has a mean."""
REACH = 0.75
"""A cell joins a stronger one if their mean positions are nearer than this, in sides of a cell.
Otherwise, points at the border of two cells would be torn apart."""
NEIGHBOURS = 9
"""A cell with its eight neighbours."""


class PairPoints(NamedTuple):
    """The matches of a pair, as points of both photos."""

    names: tuple[str, str]
    xy0: np.ndarray
    """float32 (n, 2), original pixels of the first photo."""
    xy1: np.ndarray
    """float32 (n, 2), of the second photo."""
    scores: np.ndarray
    """float64 (n,), above 0: the certainty of each match."""


def read_dense_matches(path: Path, sizes: Mapping[str, tuple[int, int]], *, where: str) -> Tables:
    """Read the matches of pairs of photos, and gather their points to keypoints (`gather_pairs`).

    Args:
      sizes: the photos, by name: (width, height), pixels. Other photos in the file are ignored.
      where: beginning of messages.

    Raises:
      UserError: the file is missing, is not HDF5, is damaged, has no pair of these photos, or does
        not tell two photos apart.
    """
    if not path.is_file():
        raise UserError(f"{where}: no such file")
    known: dict[str, str] = {}
    for name in sizes:
        short = name.replace("/", "-")
        if known.setdefault(short, name) != name:
            raise UserError(f"{where}: cannot tell {shown_name(name)} from {known[short]}")
    try:
        with h5py.File(path, "r") as file:
            pairs = [
                _points(group, (name0, name1), sizes, f"{where}: {describe((name0, name1))}")
                for name0, name1, group in pairs_in(file, known, "keypoints0")
            ]
    except DAMAGED as error:
        raise UserError(f"{where}: not a readable file of matches ({error})") from error
    pairs = _once(pairs, where)
    if not pairs:
        raise UserError(f"{where}: no pair of the photos has keypoints0 and keypoints1 in it")
    cell_px = {name: CELL_SHARE * max(size) for name, size in sizes.items()}
    keypoints, matches = gather_pairs(pairs, cell_px)
    return Tables({}, {}, keypoints, matches, {})


def _once(pairs: Iterable[PairPoints], where: str) -> list[PairPoints]:
    """The pairs that have matches; UserError if a pair is given in both orders."""
    found: dict[frozenset[str], PairPoints] = {}
    for each in pairs:
        if each.names[0] == each.names[1]:
            raise UserError(f"{where}: {shown_name(each.names[0])} is matched with itself")
        if found.setdefault(frozenset(each.names), each) is not each:
            raise UserError(f"{where}: {describe(each.names)} is given twice")
    return [each for each in found.values() if len(each.scores)]


def _points(
    group: h5py.Group,
    names: tuple[str, str],
    sizes: Mapping[str, tuple[int, int]],
    where: str,
) -> PairPoints:
    xy0, xy1 = (
        checked_keypoints(dataset(group, key, where, MAX_KEYPOINTS), where)
        for key in ("keypoints0", "keypoints1")
    )
    for name, xy in zip(names, (xy0, xy1), strict=True):
        if (np.abs(xy - np.clip(xy, 0, np.asarray(sizes[name]) - 1)) > BORDER_PX).any():
            width, height = sizes[name]
            raise UserError(
                f"{where}: {shown_name(name)} has keypoints outside its {width} x {height} pixels"
            )
    scores = np.ones(len(xy0))
    if "scores" in group:
        scores = dataset(group, "scores", where, MAX_KEYPOINTS).astype(np.float64).reshape(-1)
    if not len(xy0) == len(xy1) == len(scores) or not np.isfinite(scores).all():
        raise UserError(
            f"{where}: keypoints0, keypoints1 and scores must be of the same matches; got "
            f"{len(xy0)}, {len(xy1)} and {len(scores)}"
        )
    return PairPoints(names, xy0, xy1, np.maximum(scores, LEAST_SCORE))


def gather(xy: np.ndarray, weight: np.ndarray, cell_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Gather points near each other.

    The points of a cell become one keypoint, at their weighted mean. A cell that lies near a
    stronger one joins it, if that one is the strongest around. The result does not depend on the
    order of the points.

    Args:
      xy: (n, 2), pixels.
      weight: (n,), above 0.
      cell_px: the side of a cell, pixels.

    Returns:
      float32 (k, 2) keypoints; int (n,), the keypoint of each point.
    """
    if not len(xy):
        return np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
    order = np.lexsort((weight, xy[:, 1], xy[:, 0]))  # so that sums round in the same way
    cells, of = np.unique(np.floor(xy / cell_px).astype(np.int64), axis=0, return_inverse=True)
    of = of.reshape(-1)
    middle, total = _means(xy, weight, of, order, len(cells))
    rank = np.empty(len(cells), np.int64)
    rank[np.lexsort((cells[:, 1], cells[:, 0], -total))] = np.arange(len(cells))
    count = min(NEIGHBOURS, len(cells))
    distance, near = KDTree(middle).query(middle, k=count)
    distance, near = distance.reshape(-1, count), near.reshape(-1, count)
    found = np.where(distance <= REACH * cell_px, rank[near], len(cells))
    strongest = np.argsort(rank)[found.min(1)]  # a cell is near itself
    peak = strongest == np.arange(len(cells))
    target = np.where(peak[strongest], strongest, np.arange(len(cells)))
    kept, label = np.unique(target, return_inverse=True)
    label = label.reshape(-1)[of]
    keypoints, _ = _means(xy, weight, label, order, len(kept))
    return keypoints.astype(np.float32), label


def _means(
    xy: np.ndarray, weight: np.ndarray, label: np.ndarray, order: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The weighted means (count, 2) of labelled points and the sums (count,) of their weights."""
    own, w = label[order], weight[order].astype(np.float64)
    total = np.bincount(own, w, count)
    sums = [np.bincount(own, w * xy[order, k], count) for k in (0, 1)]
    return np.stack(sums, axis=1) / total[:, None], total


def gather_pairs(
    pairs: Iterable[PairPoints], cell_px: dict[str, float]
) -> tuple[dict[str, np.ndarray], dict[Pair, np.ndarray]]:
    """Keypoints that pairs share, and the matches of the pairs between them.

    Where several matches of a pair join the same two keypoints, or several keypoints want the same
    one, the matches with the largest sum of scores count.

    Args:
      cell_px: by name of a photo, the side of its cells, pixels.

    Returns:
      By photo float32 (k, 2) keypoints; by pair int32 (m, 2) indices of keypoints, one to one.
    """
    given = sorted(pairs, key=lambda each: each.names)
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for each in given:
        for name, xy in zip(each.names, (each.xy0, each.xy1), strict=True):
            parts.setdefault(name, []).append((xy, each.scores))
    keypoints, labels = {}, {}
    for name, own in parts.items():
        xy, scores = (np.concatenate(column) for column in zip(*own, strict=True))
        keypoints[name], label = gather(xy, scores, cell_px[name])
        ends = np.cumsum([len(xy) for xy, _ in own])[:-1]
        labels[name] = iter(np.split(label, ends))
    matches: dict[Pair, np.ndarray] = {}
    for each in given:
        rows = np.stack([next(labels[name]) for name in each.names], axis=1)
        chosen = _one_to_one(rows, each.scores)
        pair = make_pair(*each.names)
        if len(chosen):
            matches[pair] = (chosen if pair == each.names else chosen[:, ::-1]).astype(np.int32)
    return keypoints, matches


def _one_to_one(rows: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """The matches (m, 2) with the largest sums of scores, each keypoint at most once.

    A match is taken if it is the best one of both its keypoints; then the same among the rest.
    """
    rows, of = np.unique(rows, axis=0, return_inverse=True)
    total = np.bincount(of.reshape(-1), scores, len(rows))
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0], -total))]
    taken = []
    while len(rows):
        first0, first1 = (np.unique(column, return_index=True)[1] for column in rows.T)
        best = rows[np.intersect1d(first0, first1)]
        taken.append(best)
        free = ~np.isin(rows[:, 0], best[:, 0]) & ~np.isin(rows[:, 1], best[:, 1])
        rows = rows[free]
    return np.concatenate(taken) if taken else np.zeros((0, 2), np.int64)
