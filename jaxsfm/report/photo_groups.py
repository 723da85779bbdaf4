"""The groups of photos that chains of trusted pairs join, and what keeps the groups apart."""

import dataclasses
from collections.abc import Collection, Iterable, Sequence

from jaxsfm.io.pairs import component_of
from jaxsfm.report.pair_outcomes import PairOutcomes, furthest
from jaxsfm.report.run_results import Component, PairRow, ViewGraph


@dataclasses.dataclass(frozen=True)
class PhotoGroup:
    """Photos that chains of trusted pairs join: a connected component of the view graph."""

    images: frozenset[str]
    inside: list[PairRow] = dataclasses.field(default_factory=list)
    """The trusted pairs among them."""
    crossing: list[PairRow] = dataclasses.field(default_factory=list)
    """The pairs that were tried between them and all other photos; none of these is trusted."""


def photo_groups(names: Iterable[str], rows: Sequence[PairRow]) -> list[PhotoGroup]:
    """All groups, the largest first. A photo without a trusted pair is a group by itself.

    Args:
      rows: pairs of the photos `names`.
    """
    trusted = [row.pair for row in rows if row.trusted]
    joined = {name for pair in trusted for name in pair}
    group_of: dict[str, PhotoGroup] = {}
    groups: list[PhotoGroup] = []
    for name in sorted(names):
        if name not in group_of:
            images = component_of([name], trusted) if name in joined else [name]
            groups.append(PhotoGroup(frozenset(images)))
            group_of |= dict.fromkeys(images, groups[-1])
    for row in sorted(rows, key=lambda row: row.pair):
        one, other = (group_of[name] for name in row.pair)
        if one is not other:
            one.crossing.append(row)
            other.crossing.append(row)
        elif row.trusted:
            one.inside.append(row)
    return sorted(groups, key=lambda group: (-len(group.images), min(group.images)))


def view_graph_report(
    groups: Sequence[PhotoGroup], best_model: Collection[str], pairs: PairOutcomes
) -> ViewGraph:
    """The groups as the report lists them."""
    index = {name: k for k, group in enumerate(groups) for name in group.images}
    rows = []
    for group in groups:
        best, nearest = furthest(group.crossing), None
        if best is not None:
            (other,) = set(best.pair) - group.images
            nearest = pairs.closest(best, component=index[other])
        rows.append(
            Component(
                images=sorted(group.images),
                pairs=len(group.inside),
                registered=len(group.images & set(best_model)),
                nearest=nearest,
            )
        )
    return ViewGraph(components=rows)
