"""How far the pairs of a run came, what each lacked, and which photos the trusted ones join."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

from jaxsfm.config import Config
from jaxsfm.io.pairs import Pair, components
from jaxsfm.report.run_results import ClosestPair, Component, PairRow, PairStatus, ViewGraph
from jaxsfm.sfm.limits import TRUST

COLMAP_MIN_INLIERS = 15
"""The fewest inliers of a pair that COLMAP verifies: its default, which this package keeps."""


def furthest(rows: Iterable[PairRow]) -> PairRow | None:
    """The pair that came furthest: the one with most inliers of COLMAP, then of homographies, then
    tentative matches, then the first by name. None if there are no pairs."""
    return min(
        rows,
        key=lambda row: (-row.colmap_inliers, -row.inliers, -row.tentative, row.pair),
        default=None,
    )


class PairOutcomes(NamedTuple):
    """The pairs that a run tried, and the options that explanations and advice depend on."""

    rows: Sequence[PairRow]
    angles: Mapping[Pair, float]
    """As `jaxsfm.report.lost_photos.explained` takes them, and so are the `sizes`."""
    sizes: Mapping[str, tuple[int, int]]
    config: Config
    selection: str
    """The value of `--pairs`."""
    known_camera: bool
    """Whether `--intrinsics` were given."""

    def missed(self, row: PairRow) -> str:
        """What a pair lacks to be used, in words and numbers; empty if it was used."""
        if row.trusted:
            return ""
        if row.verified and row.view_graph is not None:
            verdict = row.view_graph
            if verdict.rejected:
                return f"{row.colmap_inliers} inliers, but {verdict.reason}"
            if verdict.rotation_error_deg is None:
                return f"{row.colmap_inliers} inliers, but they give no relative pose"
            return (
                f"{row.colmap_inliers} inliers, but its rotation differs from that of stronger "
                f"pairs by {verdict.rotation_error_deg:.0f} deg ({TRUST.rotation_deg:.0f} deg are "
                f"allowed), and its edge weight is {verdict.edge_weight:.3f}"
                + f" (with {TRUST.strong} or more, any rotation is allowed)"
                * (verdict.edge_weight < TRUST.strong)
            )
        if row.inliers and row.handed_on:
            return (
                f"{row.inliers} matches on planes, but COLMAP found no geometry that "
                f"{COLMAP_MIN_INLIERS} of them share"
            )
        if row.inliers:
            return f"{row.inliers} matches on planes, but --best-pairs left it out"
        needed = self.config.min_inliers
        if row.status == PairStatus.TOO_FEW_MATCHES:
            return f"{row.tentative} tentative matches, {needed} are needed"
        return f"{row.tentative} tentative matches, but no homography agrees with {needed} of them"

    def widest_deg(self, rows: Iterable[PairRow]) -> float | None:
        """The largest angle of the trusted ones among `rows`, degrees; None if none is known."""
        known = [angle for row in rows if row.trusted and (angle := self.angles.get(row.pair))]
        return max(known, default=None)

    def closest(self, row: PairRow, *, component: int | None = None) -> ClosestPair:
        """A pair as the report names it: with its numbers and what it lacks."""
        return ClosestPair(
            component=component,
            pair=row.pair,
            tentative=row.tentative,
            inliers=row.inliers,
            colmap_inliers=row.colmap_inliers,
            trusted=row.trusted,
            edge_weight=row.view_graph and row.view_graph.edge_weight,
            rotation_error_deg=row.view_graph and row.view_graph.rotation_error_deg,
            missed=self.missed(row),
        )


@dataclasses.dataclass(frozen=True)
class PhotoGroup:
    """Photos that chains of trusted pairs join: a connected component of the view graph."""

    images: frozenset[str]
    inside: list[PairRow] = dataclasses.field(default_factory=list)
    """The trusted pairs among them."""
    crossing: list[PairRow] = dataclasses.field(default_factory=list)
    """The pairs that were tried between them and all other photos; none of these is trusted."""


def photo_groups(names: Iterable[str], rows: Sequence[PairRow]) -> list[PhotoGroup]:
    """All groups of the photos `names`, of which `rows` are pairs; the largest group first. A photo
    without a trusted pair is a group by itself."""
    trusted = [row.pair for row in rows if row.trusted]
    groups = [PhotoGroup(frozenset(images)) for images in components(names, trusted)]
    group_of = {name: group for group in groups for name in group.images}
    for row in sorted(rows, key=lambda row: row.pair):
        one, other = (group_of[name] for name in row.pair)
        if one is not other:
            one.crossing.append(row)
            other.crossing.append(row)
        elif row.trusted:
            one.inside.append(row)
    return groups


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
