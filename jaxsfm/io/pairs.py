"""Pairs of images and their matches: the types, files that list pairs, and choices among pairs."""

import abc
import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name

Name = TypeVar("Name", str, int)
Pair = tuple[str, str]
"""The names of two images; the first one sorts before the second."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairResult:
    """The verified matches of one pair.

    Coordinates are in pixels of the original images; the centre of the top-left pixel is (0, 0).
    """

    pair: Pair
    cells: np.ndarray
    """int32 (n, 2): for each match, the index of its keypoint in the first and second image."""
    keypoints0: np.ndarray
    """float32 (n, 2): (x, y) in the first image."""
    keypoints1: np.ndarray
    """float32 (n, 2): (x, y) in the second image."""
    plane: np.ndarray
    """int32 (n,): the index of the homography that each match agrees with."""
    homographies: np.ndarray
    """float64 (p, 3, 3): they map points of the first image to the second one."""
    num_tentative: int
    """The number of matches before verification."""
    num_dropped: int
    """The number of candidates that were lost because the list was full; 0 in practice."""
    status: Status
    """Whether the pair was verified, and if not, why."""

    @property
    def num_inliers(self) -> int:
        """The number of verified matches; each keypoint is in at most one of them."""
        return len(self.plane)

    @property
    def counts(self) -> "PairCounts":
        """The numbers of this result, small enough to keep for a hundred thousand pairs."""
        return PairCounts(
            num_inliers=self.num_inliers,
            num_planes=len(self.homographies),
            num_tentative=self.num_tentative,
            num_dropped=self.num_dropped,
            status=self.status,
        )


def united(first: PairResult, second: PairResult) -> PairResult:
    """Two results of a pair as one; their cells must differ."""

    def both(name: str) -> np.ndarray:
        return np.concatenate([getattr(first, name), getattr(second, name)])

    count = len(first.homographies)
    return dataclasses.replace(
        second,
        cells=both("cells"),
        keypoints0=both("keypoints0"),
        keypoints1=both("keypoints1"),
        plane=np.concatenate([first.plane, np.where(second.plane < 0, -1, second.plane + count)]),
        homographies=both("homographies"),
        num_tentative=first.num_tentative + second.num_tentative,
        num_dropped=first.num_dropped + second.num_dropped,
        status=second.status if second.status == Status.VERIFIED else first.status,
    )


class LazyMatches(Mapping[Pair, PairResult]):
    """The matches of `pairs`, in their order. Each is made (`_load`) when it is asked for."""

    def __init__(self, pairs: Iterable[Pair]) -> None:
        self._pairs = dict.fromkeys(pairs)

    @abc.abstractmethod
    def _load(self, pair: Pair) -> PairResult:
        """Make the matches of one of the pairs."""

    def __getitem__(self, pair: Pair) -> PairResult:
        if pair not in self._pairs:
            raise KeyError(pair)
        return self._load(pair)

    def __contains__(self, pair: object) -> bool:
        return pair in self._pairs

    def __iter__(self) -> Iterator[Pair]:
        return iter(self._pairs)

    def __len__(self) -> int:
        return len(self._pairs)


class ChosenMatches(LazyMatches):
    """Some of the matches of another mapping."""

    def __init__(self, matches: Mapping[Pair, PairResult], pairs: Iterable[Pair]) -> None:
        super().__init__(pairs)
        self._matches = matches

    def _load(self, pair: Pair) -> PairResult:
        return self._matches[pair]


class PairCounts(NamedTuple):
    """The numbers of a `PairResult` without its arrays."""

    num_inliers: int
    num_planes: int
    num_tentative: int
    num_dropped: int
    status: Status


def make_pair(a: Name, b: Name) -> tuple[Name, Name]:
    """Two names as a pair, in order."""
    return (a, b) if a <= b else (b, a)


def exhaustive_pairs(names: Iterable[str]) -> list[Pair]:
    """Return all pairs of the images, sorted."""
    return list(itertools.combinations(sorted(names), 2))


def _split(line: str, known: set[str]) -> Pair | None:
    """Cut a line into two names, at a tab or at the blank that has a known name on each side."""
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


def listed_lines(path: Path, option: str) -> list[tuple[int, str]]:
    """The stripped lines of a text file, with their numbers, without comments (#) and empty ones.

    Raises:
      UserError: the file that the option names cannot be read as text.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{option} {path}: cannot be read as text") from error
    stripped = enumerate(map(str.strip, lines), start=1)
    return [(k, line) for k, line in stripped if line and not line.startswith("#")]


def read_pairs(path: Path, known: Iterable[str]) -> list[Pair]:
    """Read pairs from a text file that has two names on each line, separated by a blank or a tab.

    Lines that start with # are comments. Names may contain blanks. A name that contains a newline
    or starts with # cannot be written in such a file.

    Args:
      known: the names of the images in the folder.

    Returns: the pairs, sorted, each once.

    Raises:
      UserError: the file cannot be read, a line does not name two different images, or there are
        no pairs in it.
    """
    names = set(known)
    pairs = set()
    for number, line in listed_lines(path, "--pairs"):
        cut = _split(line, names)
        if cut is None:
            raise UserError(f"--pairs {path} line {number}: expected two image names; got {line!r}")
        for name in cut:
            if name not in names:
                raise UserError(f"--pairs {path} line {number}: no image named {name!r}")
        if cut[0] == cut[1]:
            raise UserError(f"--pairs {path} line {number}: {cut[0]!r} is paired with itself")
        pairs.add(make_pair(*cut))
    if not pairs:
        raise UserError(f"--pairs {path}: the file lists no pairs")
    return sorted(pairs)


def best_pairs(num_inliers: Mapping[Pair, int], n: int) -> set[Pair]:
    """The union over all images of an image's n pairs with the most inliers.

    A pair is kept if it is among the best of *either* image. So the result does not depend on the
    order of the images; the paper's code keeps (i, j) only if j is in the list of the
    lower-numbered i. Pairs without inliers are never kept. Equal counts are decided by name. Raises
    ValueError if n is less than 1.
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
    """Return all images that can be reached from `seeds` along `edges`, `seeds` included."""
    return _reached(seeds, _beside(edges))


def components(names: Iterable[str], edges: Iterable[Pair]) -> list[set[str]]:
    """The groups of images that edges join, the largest first, then by the first name.

    An image without an edge is a group by itself.
    """
    beside, found, done = _beside(edges), list[set[str]](), set[str]()
    for name in sorted(names):
        if name not in done:
            found.append(_reached([name], beside))
            done |= found[-1]
    return sorted(found, key=lambda group: (-len(group), min(group)))


def _beside(edges: Iterable[Pair]) -> dict[str, set[str]]:
    """The images that edges join each image with."""
    beside: dict[str, set[str]] = {}
    for a, b in edges:
        beside.setdefault(a, set()).add(b)
        beside.setdefault(b, set()).add(a)
    return beside


def _reached(seeds: Iterable[str], beside: Mapping[str, set[str]]) -> set[str]:
    reached, queue = set(seeds), list(seeds)
    while queue:
        for name in beside.get(queue.pop(), set()) - reached:
            reached.add(name)
            queue.append(name)
    return reached


def describe(pair: Pair) -> str:
    """Return the name of a pair for messages."""
    return f"{shown_name(pair[0])} - {shown_name(pair[1])}"
