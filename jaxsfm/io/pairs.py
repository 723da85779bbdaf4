"""Which pairs are tried, what came of each, and which are handed on."""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name

Pair = tuple[str, str]
"""Two image names, the lesser first."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairResult:
    """The verified matches of one pair, in original pixels."""

    pair: Pair
    cells: np.ndarray
    """int32 (n, 2): the keypoints' indices in either image."""
    keypoints0: np.ndarray
    """float32 (n, 2): (x, y), original pixels of the first image, top-left centre (0, 0)."""
    keypoints1: np.ndarray
    plane: np.ndarray
    """int32 (n,): which homography each match belongs to."""
    homographies: np.ndarray
    """float64 (p, 3, 3): first image to second, original pixels."""
    num_tentative: int
    num_dropped: int
    """Candidates beyond the list's capacity, lost; 0 in practice."""
    status: Status

    @property
    def num_inliers(self) -> int:
        """One-to-one verified matches."""
        return len(self.plane)

    @property
    def counts(self) -> "PairCounts":
        """What can be held of a hundred thousand pairs."""
        return PairCounts(
            num_inliers=self.num_inliers,
            num_planes=len(self.homographies),
            num_tentative=self.num_tentative,
            num_dropped=self.num_dropped,
            status=self.status,
        )


class PairCounts(NamedTuple):
    """A pair's result in numbers."""

    num_inliers: int
    num_planes: int
    num_tentative: int
    num_dropped: int
    status: Status


def make_pair(a: str, b: str) -> Pair:
    """The pair in canonical order."""
    return (a, b) if a <= b else (b, a)


def exhaustive_pairs(names: Iterable[str]) -> list[Pair]:
    """All pairs, in order of their names."""
    return list(itertools.combinations(sorted(names), 2))


def _split(line: str, known: set[str]) -> Pair | None:
    """The one way to cut a line into two known names (names may hold blanks)."""
    if "\t" in line:
        a, _, b = line.partition("\t")
        return (a.strip(), b.strip())
    cuts = [i for i, char in enumerate(line) if char == " "]
    for i in cuts:
        a, b = line[:i].strip(), line[i:].strip()
        if a in known and b in known:
            return (a, b)
    parts = line.split()
    return (parts[0], parts[1]) if len(parts) == 2 else None


def read_pairs(path: Path, known: Iterable[str]) -> list[Pair]:
    """Pairs from a text file: two names a line, by a blank or a tab; # starts a comment.

    Names may hold blanks; names with a newline, or with # first, cannot be written in such a file.

    Args:
      known: the image folder's names.

    Raises:
      UserError: the file, the line and what is wrong with it.
    """
    names = set(known)
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--pairs {path}: cannot be read as text") from error
    pairs = set()
    for number, line in enumerate(lines, start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        cut = _split(line, names)
        if cut is None:
            raise UserError(f"--pairs {path} line {number}: expected two image names; got {line!r}")
        for name in cut:
            if name not in names:
                raise UserError(f"--pairs {path} line {number}: no image named {name!r}")
        if cut[0] == cut[1]:
            raise UserError(f"--pairs {path} line {number}: {cut[0]!r} paired with itself")
        pairs.add(make_pair(*cut))
    if not pairs:
        raise UserError(f"--pairs {path}: no pairs in it")
    return sorted(pairs)


def best_pairs(num_inliers: Mapping[Pair, int], n: int) -> set[Pair]:
    """Every image's n pairs with the most inliers, as a union.

    A pair stays if it is among the best of *either* image, so nothing depends on the order of the
    images (the authors' code keeps (i, j) only when j is in the list of the lower-numbered i).
    Pairs without inliers never stay; equal counts are decided by name.
    """
    if n < 1:
        raise ValueError(f"n must be at least 1; got {n}")
    ranked: dict[str, list[tuple[int, str, Pair]]] = {}
    for pair, count in num_inliers.items():
        if count > 0:
            for image, other in (pair, pair[::-1]):
                ranked.setdefault(image, []).append((-count, other, pair))
    return {pair for rows in ranked.values() for _, _, pair in sorted(rows)[:n]}


def component_of(seeds: Iterable[str], edges: Iterable[Pair]) -> set[str]:
    """All images reachable from `seeds` over `edges`."""
    neighbours: dict[str, set[str]] = {}
    for a, b in edges:
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    reached, queue = set(seeds), list(seeds)
    while queue:
        for name in neighbours.get(queue.pop(), set()) - reached:
            reached.add(name)
            queue.append(name)
    return reached


def describe(pair: Pair) -> str:
    """A pair's name in messages."""
    return f"{shown_name(pair[0])} - {shown_name(pair[1])}"
