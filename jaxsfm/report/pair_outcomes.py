"""How far every pair of a run came, and what it lacked."""

import dataclasses
from collections.abc import Iterable, Mapping

from jaxsfm.core.types import Status
from jaxsfm.io.pairs import Pair
from jaxsfm.report.run_results import ClosestPair, PairRow
from jaxsfm.sfm.view_graph import STRONG, TOLERANCE_DEG

COLMAP_MIN_INLIERS = 15
"""The fewest inliers of a pair that COLMAP verifies: its default, which this package keeps."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairOutcomes:
    """The numbers of every pair that was tried."""

    rows: Mapping[Pair, PairRow]
    angles: Mapping[Pair, float]
    """The angle at which the rays of a verified pair's points meet (median), degrees; 0 where it
    is unknown."""
    min_inliers: int
    """The fewest tentative matches of a pair that is looked at, and inliers of a homography."""

    def trusted(self, pair: Pair) -> bool:
        """Whether the pair was given to the mapper."""
        return self.rows[pair].trusted

    def verified(self, pair: Pair) -> bool:
        """Whether COLMAP verified the pair."""
        return self.rows[pair].colmap_inliers > 0

    def best(self, pairs: Iterable[Pair]) -> Pair | None:
        """The pair that came furthest: the one with most inliers of COLMAP, then of homographies,
        then tentative matches, then the first by name."""

        def nearest_first(pair: Pair) -> tuple[int, int, int, Pair]:
            row = self.rows[pair]
            return -row.colmap_inliers, -row.inliers, -row.tentative, pair

        return min(pairs, key=nearest_first, default=None)

    def missed(self, pair: Pair) -> str:
        """What a pair lacks to be used, in words and numbers; empty if it was used."""
        row = self.rows[pair]
        if row.trusted:
            return ""
        if row.view_graph is not None and self.verified(pair):
            verdict = row.view_graph
            if verdict.rotation_error_deg is None:
                return f"{row.colmap_inliers} inliers, but they give no relative pose"
            return (
                f"{row.colmap_inliers} inliers, but its rotation differs from that of stronger "
                f"pairs by {verdict.rotation_error_deg:.0f} deg ({TOLERANCE_DEG:.0f} deg are "
                f"allowed), and its strength is {verdict.strength:.3f} (a pair of strength "
                f"{STRONG} or more may have any rotation)"
            )
        if row.inliers and row.handed_on:
            return (
                f"{row.inliers} matches on planes, but COLMAP found no geometry that "
                f"{COLMAP_MIN_INLIERS} of them share"
            )
        if row.inliers:
            return f"{row.inliers} matches on planes, but --best-pairs left it out"
        if row.status == Status.TOO_FEW_MATCHES:
            return f"{row.tentative} tentative matches, {self.min_inliers} are needed"
        return (
            f"{row.tentative} tentative matches, but no homography agrees with "
            f"{self.min_inliers} of them"
        )

    def widest_deg(self, pairs: Iterable[Pair]) -> float | None:
        """The largest angle of the trusted ones among `pairs`, degrees; None if none is known."""
        known = [angle for p in pairs if self.trusted(p) and (angle := self.angles.get(p))]
        return max(known, default=None)

    def closest(self, pair: Pair, *, component: int | None = None) -> ClosestPair:
        """A pair as the report names it: with its numbers and what it lacks."""
        row = self.rows[pair]
        return ClosestPair(
            component=component,
            pair=pair,
            tentative=row.tentative,
            inliers=row.inliers,
            colmap_inliers=row.colmap_inliers,
            trusted=row.trusted,
            strength=row.view_graph and row.view_graph.strength,
            rotation_error_deg=row.view_graph and row.view_graph.rotation_error_deg,
            missed=self.missed(pair),
        )
