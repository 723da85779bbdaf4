"""The groups of photos that chains of trusted pairs join, and what keeps the groups apart."""

import dataclasses
from collections.abc import Collection, Iterable, Sequence

from jaxsfm.io.pairs import Pair, component_of
from jaxsfm.report.pair_outcomes import PairOutcomes
from jaxsfm.report.run_results import Component, ViewGraph


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhotoGroup:
    """Photos that chains of trusted pairs join: a connected component of the view graph."""

    images: frozenset[str]
    pairs: int
    """The number of trusted pairs among them."""
    crossing: list[Pair]
    """The pairs that were tried between them and all other photos; none of these is trusted."""


def photo_groups(names: Iterable[str], pairs: PairOutcomes) -> list[PhotoGroup]:
    """All groups, the largest first. A photo without a trusted pair is a group by itself."""
    trusted = [pair for pair in pairs.rows if pairs.trusted(pair)]
    joined = {name for pair in trusted for name in pair}
    groups: list[frozenset[str]] = []
    seen: set[str] = set()
    for name in sorted(names):
        if name not in seen:
            group = frozenset(component_of([name], trusted) if name in joined else [name])
            groups.append(group)
            seen |= group
    groups.sort(key=lambda group: (-len(group), min(group)))
    index = _index(groups)
    crossing: list[list[Pair]] = [[] for _ in groups]
    inside = [0] * len(groups)
    for pair in sorted(pairs.rows):
        if not index.keys() >= set(pair):
            continue
        a, b = index[pair[0]], index[pair[1]]
        if a != b:
            crossing[a].append(pair)
            crossing[b].append(pair)
        else:
            inside[a] += pairs.trusted(pair)
    return [
        PhotoGroup(images=group, pairs=inside[k], crossing=crossing[k])
        for k, group in enumerate(groups)
    ]


def _index(groups: Iterable[Collection[str]]) -> dict[str, int]:
    """The place of every photo's group."""
    return {name: k for k, group in enumerate(groups) for name in group}


def view_graph_report(
    groups: Sequence[PhotoGroup], best_model: Collection[str], pairs: PairOutcomes
) -> ViewGraph:
    """The groups as the report lists them."""
    index = _index([group.images for group in groups])
    rows = []
    for group in groups:
        best, nearest = pairs.best(group.crossing), None
        if best is not None:
            other = best[1] if best[0] in group.images else best[0]
            nearest = pairs.closest(best, component=index[other])
        rows.append(
            Component(
                images=sorted(group.images),
                pairs=group.pairs,
                registered=len(group.images & set(best_model)),
                nearest=nearest,
            )
        )
    return ViewGraph(components=rows)
