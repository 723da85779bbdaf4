"""Reads the matches of detector-free matchers, in the layout in which hloc stores them (HDF5).

Layout (hloc/match_dense.py): group NAME0/NAME1, each name's '/' turned into '-' (older files:
NAME0_NAME1), with `keypoints0` and `keypoints1` (n, 2), (x, y) of the original photos, centre of
the top-left pixel (0, 0), and `scores` (n,). hloc may have added `matches0` to the group, which is
not read.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import h5py
import numpy as np

from jaxsfm.colmap.formats.gathered import PairPoints, gather_pairs
from jaxsfm.colmap.formats.hloc import DAMAGED, dataset, pairs_in
from jaxsfm.colmap.formats.tables import MAX_KEYPOINTS, Tables, checked_keypoints
from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import describe

CELL_SHARE = 1 / 400
"""The side of a cell as a share of the photo's longer side: 4 pixels of 1600."""
BORDER_PX = 1.5
"""Keypoints may lie so far beyond the centres of the outermost pixels."""
LEAST_SCORE = 1e-6
"""Smaller scores count as this one, so that a cell has a mean."""


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
