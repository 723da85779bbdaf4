"""A street whose matches are computed from exact points, without pictures, features or a network.

The cameras are those of `jaxsfm.bench.long_street`. Each photo shows some of the points before it,
each in a cell of its own and a pixel or two beside its true place, as relocalized keypoints are. So
matches for any number of photos take little time and memory, and what a run does with them can be
measured and tested. Results on it must be called synthetic.
"""

import functools
import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.bench.long_street import DEPTH, SIZE, walk
from jaxsfm.bench.synthetic import camera_matrix
from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairResult, make_pair

REACH = 12
"""Each photo is matched with so many that follow it. The next one shares too little."""
CELL = 8
"""Pixels of a cell on a side."""
SEEN = 0.8
"""The share of the points before a camera that a photo has keypoints of."""
NOISE_PX = 1.0
"""Of a keypoint, in x and in y."""
HEIGHT = (-3.0, 1.5)
"""From where to where points lie, metres; y is down."""
BLOCK = 5.0
"""Points are drawn for stretches of the street of this length, metres."""
FIRST_BLOCK = 1000
"""Stretches are counted from this many before the beginning, so that no number is negative."""


class SimulatedPhoto(NamedTuple):
    """The keypoints of a photo."""

    points: np.ndarray
    """int64 (n,), ascending: which points they show."""
    cells: np.ndarray
    """int32 (n,): the cell that each lies in."""
    xy: np.ndarray
    """float32 (n, 2), pixels; the centre of the top-left pixel is (0, 0)."""


class SimulatedStreet:
    """Photos along a street. The same numbers give the same street."""

    def __init__(self, photos: int, *, density: float = 40.0, seed: int = 0) -> None:
        """
        Args:
          photos: their number.
          density: points on a square metre.
          seed: of the points, the keypoints and the cameras.
        """
        self.poses = walk(photos, seed=seed)
        self._seed, self._count = seed, round(density * BLOCK * (HEIGHT[1] - HEIGHT[0]))
        self._photo = functools.lru_cache(4 * REACH)(self._make_photo)
        self._block = functools.lru_cache(4 * REACH)(self._make_block)

    def images(self) -> list[ImageFile]:
        """The photos as files, which do not exist."""
        return [
            ImageFile(
                name=self.name(k),
                path=Path(self.name(k)),
                size=SIZE,
                sha256=hashlib.sha256(b"%d %d" % (self._seed, k)).hexdigest(),
            )
            for k in range(len(self.poses))
        ]

    def intrinsics(self) -> str:
        """The camera of all photos, as `--intrinsics` takes it."""
        k = camera_matrix(SIZE)
        return f"PINHOLE:{k[0, 0]},{k[1, 1]},{k[0, 2] + 0.5},{k[1, 2] + 0.5}"

    def name(self, k: int) -> str:
        """The name of a photo."""
        return f"photo{k:06d}.png"

    def pairs(self) -> list[Pair]:
        """All pairs that are matched, in order."""
        count = len(self.poses)
        return sorted(
            make_pair(self.name(i), self.name(j))
            for i in range(count)
            for j in range(i + 1, min(count, i + REACH + 1))
        )

    def photo(self, k: int) -> SimulatedPhoto:
        """The keypoints of a photo."""
        return self._photo(k)

    def point(self, number: int) -> np.ndarray:
        """A point of the street, float64 (3,), metres."""
        stretch, index = divmod(number, self._count)
        return self._block(stretch - FIRST_BLOCK)[index]

    def matches(self, pair: Pair) -> PairResult:
        """The matches of two photos: the points that both show."""
        one, other = (self._photo(int(name[5:11])) for name in pair)
        _, i, j = np.intersect1d(one.points, other.points, assume_unique=True, return_indices=True)
        return PairResult(
            pair=pair,
            cells=np.stack([one.cells[i], other.cells[j]], axis=1),
            keypoints0=one.xy[i],
            keypoints1=other.xy[j],
            plane=np.zeros(len(i), np.int32),
            homographies=np.eye(3)[None],
            num_tentative=len(i),
            num_dropped=0,
            status=Status.VERIFIED,
        )

    def _make_block(self, number: int) -> np.ndarray:
        """The points of a stretch of the street, float64 (n, 3)."""
        rng = np.random.default_rng([self._seed, 1, number + FIRST_BLOCK])
        x = BLOCK * (number + rng.random(self._count))
        y = rng.uniform(*HEIGHT, self._count)
        return np.stack([x, y, DEPTH + rng.uniform(-1, 1, self._count)], axis=1)

    def _make_photo(self, k: int) -> SimulatedPhoto:
        pose, camera = self.poses[k], camera_matrix(SIZE)
        at = int(pose.centre[0] // BLOCK)
        blocks = range(at - 2, at + 3)
        points = np.concatenate([self._block(number) for number in blocks])
        ids = np.concatenate(
            [(number + FIRST_BLOCK) * self._count + np.arange(self._count) for number in blocks]
        )
        x, y, depth = camera @ pose.rotation @ (points - pose.centre).T
        rng = np.random.default_rng([self._seed, 2, k])
        xy = np.stack([x, y], axis=1) / depth[:, None] + rng.normal(0, NOISE_PX, (len(points), 2))
        last = np.asarray(SIZE) - 1
        shown = (depth > 0) & (xy >= 0).all(1) & (xy <= last).all(1) & (rng.random(len(xy)) < SEEN)
        rows = np.flatnonzero(shown)
        columns = -(-SIZE[0] // CELL)
        cells = (xy[rows] // CELL @ [1, columns]).astype(np.int32)
        cells, first = np.unique(cells, return_index=True)
        order = np.argsort(ids[rows[first]])
        rows, cells = rows[first][order], cells[order]
        return SimulatedPhoto(ids[rows], cells, xy[rows].astype(np.float32))
