"""How the models of parts lie in one frame.

Two models that share photos give a similarity between their frames. Where models lie in a ring, or
each shares photos with several others, these similarities do not fit together exactly, because
models are bent. So the frames of all models are found together: they bring the points that models
share as near to each other as they can.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_array
from scipy.spatial.transform import Rotation

from jaxsfm.sfm.evaluation import Similarity

IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


class SharedPoints(NamedTuple):
    """What two models have in common: points that fall together under a similarity."""

    first: np.ndarray
    """float64 (n, 3), in the frame of the first model."""
    second: np.ndarray
    """float64 (n, 3), the same points in the frame of the second one."""
    similarity: Similarity
    """From the frame of the second model to that of the first one."""

    def turned(self) -> "SharedPoints":
        """The same with the models exchanged."""
        return SharedPoints(self.second, self.first, inverse(self.similarity))


def inverse(by: Similarity) -> Similarity:
    """The similarity that takes everything back."""
    back = by.rotation.T
    return Similarity(1 / by.scale, back, -back @ by.translation / by.scale)


def after(outer: Similarity, inner: Similarity) -> Similarity:
    """First the inner similarity, then the outer one."""
    turned = outer.rotation @ inner.rotation
    moved = outer.moved_points(inner.translation[None])[0]
    return Similarity(outer.scale * inner.scale, turned, moved)


def common_frames(
    count: int, shared: Mapping[tuple[int, int], SharedPoints]
) -> list[dict[int, Similarity]]:
    """The frames of models that are joined, directly or by others, one group after the other.

    Args:
      count: the number of models, the one with most photos first.
      shared: what pairs of them share.

    Returns:
      for each group, by the number of each of its models, the similarity from its frame to that of
      the first model of the group.
    """
    both = dict(shared) | {(j, i): each.turned() for (i, j), each in shared.items()}
    groups, left = [], set(range(count))
    while left:
        found = {min(left): IDENTITY}
        while reached := [(i, j) for i, j in both if i in found and j not in found]:
            i, j = max(reached, key=lambda pair: (len(both[pair].first), -pair[0], -pair[1]))
            found[j] = after(found[i], both[i, j].similarity)
        inside = {pair: each for pair, each in shared.items() if pair[0] in found}
        groups.append(_together(found, inside))
        left -= found.keys()
    return groups


def _together(
    start: dict[int, Similarity], shared: Mapping[tuple[int, int], SharedPoints]
) -> dict[int, Similarity]:
    """Frames under which the points that models share lie as near to each other as possible.

    The first frame stays. If no models lie in a ring, the start is as good as any other.

    Args:
      start: a first guess, along a tree of models.
    """
    if len(shared) < len(start):
        return start
    fixed, *moving = start
    size = {k: float(np.ptp(each.first, axis=0).max()) for k, each in shared.items()}

    def frames(x: np.ndarray) -> dict[int, Similarity]:
        found = {fixed: start[fixed]}
        for number, row in zip(moving, x.reshape(-1, 7), strict=True):
            turn = Rotation.from_rotvec(row[1:4]).as_matrix() @ start[number].rotation
            scale = start[number].scale * np.exp(row[0])
            found[number] = Similarity(scale, turn, start[number].translation + row[4:])
        return found

    def residuals(x: np.ndarray) -> np.ndarray:
        at = frames(x)
        return np.concatenate(
            [
                (at[i].moved_points(each.first) - at[j].moved_points(each.second)).ravel()
                # In units of the place, and not of the frame, or shrinking would be a gain.
                / (np.sqrt(at[i].scale * at[j].scale) * max(size[i, j], 1e-12))
                for (i, j), each in shared.items()
            ]
        )

    pattern = lil_array((3 * sum(len(e.first) for e in shared.values()), 7 * len(moving)))
    row = 0
    for pair, each in shared.items():
        for number in set(pair) - {fixed}:
            column = 7 * moving.index(number)
            pattern[row : row + 3 * len(each.first), column : column + 7] = 1
        row += 3 * len(each.first)
    found = least_squares(
        residuals,
        np.zeros(7 * len(moving)),
        jac_sparsity=pattern.tocsr(),
        loss="soft_l1",
        f_scale=0.02,
        x_scale="jac",
        max_nfev=50,
    )
    return frames(found.x)
