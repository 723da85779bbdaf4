"""Groups of views that agree, and which groups contradict each other. Pure functions of numpy
arrays.
"""

from typing import NamedTuple

import numpy as np

from jaxsfm.sfm.check.agreement import Agreement

MAX_CONTRADICTED = 0.03
"""Groups contradict each other if a larger share of the points of each one is contradicted by the
other (`share`). On castle-P19, single true pairs reach 0.037 and groups 0.02. The two halves that
are taken for each other have 0.69; faces of rendered prisms that differ in one poster 0.04-0.2."""
MIN_TESTED = 30
"""Fewer tested points say nothing about two groups."""


class OpposedGroups(NamedTuple):
    """Two groups of views that contradict each other."""

    groups: tuple[list[int], list[int]]
    """Indices of views."""
    tested: int
    """Points of one group that were tested in the other one, in the direction with fewer
    contradictions."""
    contradicted: int


class Grouping(NamedTuple):
    """All views of a model in groups."""

    groups: list[list[int]]
    """Indices of views, the largest group first."""
    contradictions: list[OpposedGroups]
    """Groups between which there is neither agreement nor contradiction are not listed."""


def share(tested: np.ndarray, contradicted: np.ndarray) -> np.ndarray:
    """float (v, v): the share of contradictions, of the direction with fewer of them; NaN where
    too little was tested.

    If two places were taken for one, points of either are missing in the views of the other. But
    what hides points in one photo, such as a passer-by, has no points of its own in other photos.
    """
    enough = np.minimum(tested, tested.T) >= MIN_TESTED
    ratio = contradicted / np.maximum(tested, 1)
    return np.where(enough, np.minimum(ratio, ratio.T), np.nan)


def group_views(agreement: Agreement) -> Grouping:
    """Join views to groups, those first that agree most surely.

    In each step, the two groups are joined whose share of contradictions is surely lowest: one
    contradiction is added, so that of two shares of zero the one with more tests is lower. Counts
    of groups are sums over their views. It ends when only groups are left that contradict each
    other, or about which nothing can be said. The order of views has an effect only among equals.
    """
    tested, contradicted = (np.array(each, float) for each in agreement)
    members = [[k] for k in range(len(tested))]
    while len(members) > 1:
        shares = share(tested, contradicted)
        with np.errstate(invalid="ignore"):
            open_to = shares <= MAX_CONTRADICTED
        sure = np.where(open_to, share(tested, contradicted + 1), np.inf)
        sure[np.tril_indices(len(members))] = np.inf
        first, second = np.unravel_index(np.argmin(sure), sure.shape)
        if not np.isfinite(sure[first, second]):
            break
        members[first] = sorted(members[first] + members.pop(second))
        for counts in (tested, contradicted):
            counts[first] += counts[second]
            counts[:, first] += counts[:, second]
        tested, contradicted = (
            np.delete(np.delete(each, second, 0), second, 1) for each in (tested, contradicted)
        )
    shares = share(tested, contradicted)
    found = []
    for i, j in zip(*np.triu_indices(len(members), 1), strict=True):
        if not np.isnan(shares[i, j]):
            ratios = [contradicted[a, b] / tested[a, b] for a, b in ((i, j), (j, i))]
            a, b = (i, j) if ratios[0] <= ratios[1] else (j, i)
            both = (members[i], members[j])
            found.append(OpposedGroups(both, int(tested[a, b]), int(contradicted[a, b])))
    return Grouping(sorted(members, key=lambda group: (-len(group), group)), found)
