"""Groups of views that agree, which groups contradict each other, how probable that makes it that
the model is wrong, and parts of a model in which none do. Pure functions of numpy arrays.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxsfm.sfm.check.agreement import Agreement
from jaxsfm.sfm.limits import CHECK


@dataclasses.dataclass(frozen=True)
class DoubtCurve:
    """The probability that a model is wrong, over its disagreement, and when it is doubted.

    Right models of ordinary photos have next to no `disagreement`, and models that take two places
    for one have much. A curve fitted to drawn models with known cameras turns it into a
    probability, and the verdict doubts a model above one limit of it. docs/decisions/one-road.md
    has the error rates over the limit.
    """

    half: float
    """The disagreement of a model that is as probably wrong as right."""
    power: float
    """The odds grow with this power of the disagreement."""
    most: float
    """A model is doubted if it is wrong with a larger probability."""

    def probability(self, disagreement: float) -> float:
        """The probability that a model with this disagreement is wrong."""
        if disagreement <= 0:
            return 0.0
        return 1 / (1 + (self.half / disagreement) ** self.power)

    def most_contradicted(self) -> float:
        """The disagreement above which a model is doubted."""
        return self.half * (self.most / (1 - self.most)) ** (1 / self.power)


CURVE = DoubtCurve(half=0.055, power=1.44, most=0.54)
"""Fitted to first mappings: 31 right ones and five wrong ones of drawn scenes of the half that
chooses, 107 right ones and three wrong ones of photos (docs/decisions/one-road.md). The right ones
have a disagreement of up to 0.053 (*brighton_gps*, seen from the air), and the wrong ones of photos
of 0.069 and more. The limit lies in the middle. Three wrong ones of drawn scenes are below it."""
MAX_CONTRADICTED = CURVE.most_contradicted()
"""Groups of photos contradict each other if a larger share of the points of each one is
contradicted by the other."""


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
    largest_share: float = 0.0
    """The largest share of contradicted points (`share`) at which two groups were joined."""


def share(tested: np.ndarray, contradicted: np.ndarray) -> np.ndarray:
    """float (v, v): the share of contradictions, of the direction with fewer of them; NaN where
    too little was tested.

    If two places were taken for one, points of either are missing in the views of the other. But
    what hides points in one photo, such as a passer-by, has no points of its own in other photos.
    """
    enough = np.minimum(tested, tested.T) >= CHECK.least_tested
    ratio = contradicted / np.maximum(tested, 1)
    return np.where(enough, np.minimum(ratio, ratio.T), np.nan)


def _sure(agreement: Agreement, rows: slice, most: float) -> tuple[np.ndarray, np.ndarray]:
    """float (r, v): how surely some groups and all others are one, the lower the surer; inf where
    more than a share of `most` is contradicted, or where too little was tested. And these shares,
    float (r, v)."""

    def shares(more: int) -> np.ndarray:
        beyond = agreement.beyond_light(rows) + more
        back = agreement.beyond_light((slice(None), rows)).T + more
        forth, back = (
            each / np.maximum(tests, 1)
            for each, tests in ((beyond, agreement.tested[rows]), (back, agreement.tested.T[rows]))
        )
        enough = np.minimum(agreement.tested[rows], agreement.tested.T[rows]) >= CHECK.least_tested
        return np.where(enough, np.minimum(forth, back), np.inf)

    contradicted = shares(0)
    allowed = np.isfinite(contradicted) & (contradicted <= most)
    return np.where(allowed, shares(1), np.inf), contradicted


def group_views(agreement: Agreement, *, most: float = MAX_CONTRADICTED) -> Grouping:
    """Join views to groups, those first that agree most surely.

    In each step, the two groups are joined whose share of contradictions is surely lowest: one
    contradiction is added, so that of two shares of zero the one with more tests is lower. Counts
    of groups are sums over their views, and what the light explains is subtracted from the sums.
    It ends when only groups are left that contradict each other, or about which nothing can be
    said. The order of views has an effect only among equals.

    Args:
      most: groups are joined if no larger share of their points is contradicted.
    """
    count = len(agreement.tested)
    groups: dict[int, list[int]] = {k: [k] for k in range(count)}
    now, (sure, shares) = agreement.copied(), _sure(agreement, slice(None), most)
    sure[np.tril_indices(count)] = np.inf
    largest = 0.0
    while len(groups) > 1:
        first, second = (int(k) for k in np.unravel_index(np.argmin(sure), sure.shape))
        if not np.isfinite(sure[first, second]):
            break
        largest = max(largest, float(shares[first, second]))
        groups[first] = sorted(groups[first] + groups.pop(second))
        now.join(first, second)
        # Only the shares of the joined group have changed.
        (row,), (own,) = _sure(now, slice(first, first + 1), most)
        row[[k for k in range(count) if k not in groups or k == first]] = np.inf
        shares[first], shares[:, first] = own, own
        sure[:first, first], sure[first, first:] = row[:first], row[first:]
        sure[second], sure[:, second] = np.inf, np.inf
    members = list(groups.values())
    left = [*groups]
    agreement = Agreement(*(each[np.ix_(left, left)] for each in now))
    tested, contradicted = agreement.tested, agreement.beyond_light()
    left_over, found = share(tested, contradicted), []
    for i, j in zip(*np.triu_indices(len(members), 1), strict=True):
        if not np.isnan(left_over[i, j]):
            ratios = [contradicted[a, b] / tested[a, b] for a, b in ((i, j), (j, i))]
            a, b = (i, j) if ratios[0] <= ratios[1] else (j, i)
            both = (members[i], members[j])
            found.append(OpposedGroups(both, int(tested[a, b]), int(contradicted[a, b])))
    in_order = sorted(members, key=lambda group: (-len(group), group))
    return Grouping(in_order, found, largest)


def disagreement(agreement: Agreement) -> float:
    """The largest share of contradicted points at which groups of views are joined to one.

    Those that agree most surely are joined first, until all views are one group.
    """
    return group_views(agreement, most=float("inf")).largest_share


def consistent_components(
    grouping: Grouping, view: np.ndarray, point: np.ndarray
) -> list[list[int]]:
    """Parts of a model in which no groups contradict each other.

    Groups are joined if they see `CHECK.least_shared` of the same points, those first that share
    most. A group is not joined to a part with a group that it contradicts.

    Args:
      view, point: int (o,), the view of each observation and its point.

    Returns:
      the indices of the views of each part, the largest part first.
    """
    group_of = np.empty(sum(map(len, grouping.groups)), np.int64)
    for k, group in enumerate(grouping.groups):
        group_of[group] = k
    count = len(grouping.groups)
    seen = np.zeros((count, int(point.max(initial=-1)) + 1), bool)
    seen[group_of[view], point] = True
    opposed = np.eye(count, dtype=bool)
    for each in grouping.contradictions:
        a, b = (group_of[group[0]] for group in each.groups)
        opposed[a, b] = opposed[b, a] = True
    members = list(grouping.groups)
    while len(members) > 1:
        shared = np.asarray([[np.sum(a & b) for b in seen] for a in seen])
        shared[opposed] = 0
        first, second = np.unravel_index(np.argmax(shared), shared.shape)
        if shared[first, second] < CHECK.least_shared:
            break
        members[first] = sorted(members[first] + members.pop(second))
        seen[first] |= seen[second]
        opposed[first] |= opposed[second]
        opposed[:, first] |= opposed[:, second]
        seen = np.delete(seen, second, 0)
        opposed = np.delete(np.delete(opposed, second, 0), second, 1)
    return sorted(members, key=lambda part: (-len(part), part))
