"""Points and their observations as arrays."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np


def grouped(of: np.ndarray, count: int) -> list[np.ndarray]:
    """For each of `count` groups the indices of its entries, ascending.

    Args:
      of: int (m,), the group of each entry.
    """
    order = np.argsort(of, kind="stable")
    return np.split(order, np.searchsorted(of[order], np.arange(1, count)))


def present_groups(of: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """The groups that have entries, ascending, each with the indices of its entries, ascending.

    Args:
      of: int (m,), the group of each entry.
    """
    order = np.argsort(of, kind="stable")
    found, starts = np.unique(of[order], return_index=True)
    return list(zip(found.tolist(), np.split(order, starts)[1:], strict=True))


class Observations(NamedTuple):
    """Where views see points: observation k is of point `point[k]`, in view `view[k]`."""

    point: np.ndarray
    """int (m,): indices of points."""
    view: np.ndarray
    """int (m,): indices of views."""
    xy: np.ndarray
    """float64 (m, 2), pixels of the view."""


class Tracks(NamedTuple):
    """Points and where views see them: observation k is of `points[point[k]]`, in `view[k]`."""

    points: np.ndarray
    """float64 (n, 3), world units."""
    point: np.ndarray
    """int (m,): index into `points`."""
    view: np.ndarray
    """int (m,): index into the views of the model."""
    xy: np.ndarray
    """float64 (m, 2), pixels of the view."""

    @classmethod
    def empty(cls) -> "Tracks":
        """No points."""
        none = np.zeros(0, np.int64)
        return cls(np.zeros((0, 3)), none, none, np.zeros((0, 2)))

    @classmethod
    def from_parts(
        cls, points: np.ndarray, parts: Iterable[Observations], *, ordered: bool = False
    ) -> "Tracks":
        """Tracks of points (n, 3) whose observations come in several parts.

        Args:
          ordered: sort the observations by point, then by view, so that later sums round in the
            same way however the parts were cut. Otherwise they keep the order of the parts.
        """
        point, view, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
        if ordered:
            order = np.lexsort((view, point))
            point, view, xy = point[order], view[order], xy[order]
        return cls(points, point, view, xy)

    @property
    def observations(self) -> Observations:
        """All observations, without the points."""
        return Observations(self.point, self.view, self.xy)

    def select(self, keep: np.ndarray) -> "Tracks":
        """Keep only some observations (a mask or indices). All points stay."""
        return Tracks(self.points, self.point[keep], self.view[keep], self.xy[keep])

    def select_points(self, rows: np.ndarray) -> "Tracks":
        """Keep only some points (their indices, ascending) and their observations."""
        place = np.full(len(self.points), -1)
        place[rows] = np.arange(len(rows))
        keep = np.flatnonzero(place[self.point] >= 0)
        return Tracks(self.points[rows], place[self.point[keep]], self.view[keep], self.xy[keep])

    def joined(self, other: "Tracks") -> "Tracks":
        """These tracks, followed by others of the same views. No point is in both."""
        return Tracks(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.point, other.point + len(self.points)]),
            np.concatenate([self.view, other.view]),
            np.concatenate([self.xy, other.xy]),
        )

    def num_observations(self) -> np.ndarray:
        """int (n,): how many observations each point has."""
        return np.bincount(self.point, minlength=len(self.points))
