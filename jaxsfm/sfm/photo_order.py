"""The order of photos as evidence: which pairs follow from it.

Photos are often numbered in the order in which they were taken, and neighbours in that order show
the same place. This joins photos of repeated structure, whose content does not tell repeats apart.
Roberts, Sinha, Szeliski and Steedly (2011), "Structure from motion for scenes with large duplicate
structures", use the times of photos in the same way.
"""

import itertools
import re
from collections.abc import Collection, Iterable, Mapping
from statistics import mode

from scipy.cluster.hierarchy import DisjointSet

from jaxsfm.io.pairs import Pair, make_pair
from jaxsfm.sfm.limits import ORDER

Order = list[str]
"""Names of photos, one taken after the other."""


def orders(names: Iterable[str]) -> list[Order]:
    """Photos that are numbered one after the other.

    Their names differ in one number only, and most numbers follow each other in equal steps.
    """
    rows: dict[tuple[str, ...], dict[int, str]] = {}
    for name in sorted(names):
        parts = re.split(r"(\d+)", name)
        for k in range(1, len(parts), 2):
            rows.setdefault((*parts[:k], "", *parts[k + 1 :]), {})[int(parts[k])] = name
    found = []
    for numbered in rows.values():
        numbers = sorted(numbered)
        steps = [after - before for before, after in itertools.pairwise(numbers)]
        if len(numbers) >= ORDER.least_numbered and steps.count(
            mode(steps)
        ) >= ORDER.equal_steps * len(steps):
            found.append([numbered[number] for number in numbers])
    return found


def ordered(found: Iterable[Order], names: Collection[str]) -> bool:
    """Whether the orders say how to join all photos."""
    return len({name for order in found for name in order}) >= ORDER.numbered_share * len(names)


def follow(found: Iterable[Order], pairs: Mapping[Pair, float]) -> set[Pair]:
    """The fewest pairs that join all photos, those of the nearest photos in the orders first.

    Among pairs that are equally near, the strongest come first. Pairs of photos that are in no
    common order come last.

    Args:
      pairs: the edge weight of each pair that may be taken.
    """
    distance: dict[Pair, int] = {}
    place = [{name: k for k, name in enumerate(order)} for order in found]
    for a, b in pairs:
        steps = [abs(at[a] - at[b]) for at in place if a in at and b in at]
        if steps:
            distance[a, b] = min(steps)
    joined = DisjointSet({name for pair in pairs for name in pair})
    taken = set()
    last = max(distance.values(), default=0) + 1
    for pair in sorted(pairs, key=lambda p: (distance.get(p, last), -pairs[p], p)):
        if joined.merge(*pair):
            taken.add(pair)
    return taken


def neighbours(pairs: Collection[Pair]) -> set[Pair]:
    """Those of the pairs whose photos follow each other in the orders of all their photos."""
    found = orders({name for pair in pairs for name in pair})
    return {make_pair(a, b) for order in found for a, b in itertools.pairwise(order)} & {*pairs}
