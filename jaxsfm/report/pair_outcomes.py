"""How far the pairs of a run came, and what each lacked to be used."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from jaxsfm.config import Config
from jaxsfm.core.types import Status
from jaxsfm.io.pairs import Pair
from jaxsfm.report.run_results import ClosestPair, PairRow
from jaxsfm.sfm.view_graph import STRONG, TOLERANCE_DEG

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
    """The angle at which the rays of a verified pair's points meet (median), degrees; 0 where it
    is unknown."""
    sizes: Mapping[str, tuple[int, int]]
    """(width, height) of every usable photo, pixels. The photos of all `rows` are among them."""
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
        needed = self.config.min_inliers
        if row.status == Status.TOO_FEW_MATCHES:
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
            strength=row.view_graph and row.view_graph.strength,
            rotation_error_deg=row.view_graph and row.view_graph.rotation_error_deg,
            missed=self.missed(row),
        )
