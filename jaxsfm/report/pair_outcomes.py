"""What became of every pair of a run, in numbers, and the groups that trusted pairs join."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from jaxsfm.core.types import Status
from jaxsfm.io.pairs import Pair, PairCounts, component_of
from jaxsfm.sfm.view_graph import STRONG, TOLERANCE_DEG, Verdict

COLMAP_MIN_INLIERS = 15
"""Fewest inliers of a pair that COLMAP verifies (its default, which this package keeps)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairOutcomes:
    """Every stage's word on the pairs that were tried."""

    results: Mapping[Pair, PairCounts]
    """Every pair tried."""
    handed_on: Collection[Pair]
    """Given to COLMAP."""
    verified: Mapping[Pair, int]
    """COLMAP's inliers, of every pair that has any."""
    verdicts: Mapping[Pair, Verdict]
    """The view graph's; empty where it is switched off."""
    angles: Mapping[Pair, float]
    """Degrees at which the rays of a verified pair's points meet (median); 0: unknown."""
    min_inliers: int
    """Fewest tentative matches of a pair that is looked at, and inliers of a homography."""

    def trusted(self, pair: Pair) -> bool:
        """Whether the pair was handed to the mapper."""
        verdict = self.verdicts.get(pair)
        return pair in self.verified and (verdict is None or verdict.trusted)

    def nearness(self, pair: Pair) -> tuple[int, int, int]:
        """How far a pair came: COLMAP's inliers, then those of its homographies, then matches."""
        counts = self.results[pair]
        return self.verified.get(pair, 0), counts.num_inliers, counts.num_tentative

    def best(self, pairs: Iterable[Pair]) -> Pair | None:
        """The one that came furthest; equal ones are decided by name."""
        return min(pairs, key=lambda p: (*(-n for n in self.nearness(p)), p), default=None)

    def missed(self, pair: Pair) -> str:
        """What a pair lacks to be used, with its numbers; empty if it was."""
        colmap, inliers, tentative = self.nearness(pair)
        if self.trusted(pair):
            return ""
        if pair in self.verified:
            verdict = self.verdicts[pair]
            if verdict.rotation_error_deg is None:
                return f"{colmap} inliers, but they give no relative pose"
            return (
                f"{colmap} inliers, but its rotation is {verdict.rotation_error_deg:.0f} deg off "
                f"({TOLERANCE_DEG:.0f} are allowed), and its strength is {verdict.strength:.3f} "
                f"({STRONG} excuses any rotation)"
            )
        if inliers and pair in self.handed_on:
            return (
                f"{inliers} matches on planes, but COLMAP found no geometry that "
                f"{COLMAP_MIN_INLIERS} of them share"
            )
        if inliers:
            return f"{inliers} matches on planes, but --best-pairs left it out"
        if self.results[pair].status == Status.TOO_FEW_MATCHES:
            return f"{tentative} tentative matches, {self.min_inliers} are needed"
        return f"{tentative} tentative matches, no homography holds {self.min_inliers} of them"

    def widest_deg(self, pairs: Iterable[Pair]) -> float | None:
        """The largest angle of trusted ones; None: there are none, or theirs is not known."""
        known = [angle for p in pairs if self.trusted(p) and (angle := self.angles.get(p))]
        return max(known, default=None)

    def row(self, pair: Pair) -> dict[str, Any]:
        """A pair's numbers, plain JSON."""
        colmap, inliers, tentative = self.nearness(pair)
        verdict = self.verdicts.get(pair)
        return {
            "pair": list(pair),
            "tentative": tentative,
            "inliers": inliers,
            "colmap_inliers": colmap,
            "trusted": self.trusted(pair),
            "strength": verdict and verdict.strength,
            "rotation_error_deg": verdict and verdict.rotation_error_deg,
            "missed": self.missed(pair),
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Component:
    """Images that chains of trusted pairs join."""

    images: frozenset[str]
    pairs: int
    """Trusted pairs among them."""
    crossing: list[Pair]
    """Pairs tried between them and all other images: none of them is trusted."""


def components(names: Iterable[str], pairs: PairOutcomes) -> list[Component]:
    """The groups, the largest first; an image that no trusted pair has is one by itself."""
    trusted = [pair for pair in pairs.results if pairs.trusted(pair)]
    joined = {name for pair in trusted for name in pair}
    groups: list[frozenset[str]] = []
    seen: set[str] = set()
    for name in sorted(names):
        if name not in seen:
            group = frozenset(component_of([name], trusted) if name in joined else [name])
            groups.append(group)
            seen |= group
    groups.sort(key=lambda group: (-len(group), min(group)))
    of = {name: k for k, group in enumerate(groups) for name in group}
    crossing: list[list[Pair]] = [[] for _ in groups]
    inside = [0] * len(groups)
    for pair in sorted(pairs.results):
        if not of.keys() >= set(pair):
            continue
        a, b = of[pair[0]], of[pair[1]]
        if a != b:
            crossing[a].append(pair)
            crossing[b].append(pair)
        else:
            inside[a] += pairs.trusted(pair)
    return [
        Component(images=group, pairs=inside[k], crossing=crossing[k])
        for k, group in enumerate(groups)
    ]
