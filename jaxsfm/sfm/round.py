"""One round of mapping: a hypothesis says which pairs are right, and the check what became of it.

Each round of a hypothesis has fewer pairs than the one before: the check has refuted those that
joined photos that contradict each other.
"""

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.two_views import PairGeometry
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import Basis, Contradiction
from jaxsfm.sfm.view_graph import Verdict

if TYPE_CHECKING:
    import pycolmap

FEWER = 0.1
"""A model is smaller than another one if it has fewer photos by more than this share of them."""


def nearly_equal(ours: int, theirs: int) -> bool:
    """Whether neither of two numbers of photos is smaller than the other one (`FEWER`)."""
    return abs(ours - theirs) <= FEWER * max(ours, theirs)


class Hypothesis(NamedTuple):
    """Which pairs are right."""

    basis: Basis
    judge: Callable[[Mapping[Pair, PairGeometry], bool], dict[Pair, Verdict]]
    """The verdicts on pairs, from their geometries. The second argument says whether pairs were
    refuted in earlier rounds. Pairs without a verdict are trusted."""


class Refuted(NamedTuple):
    """What earlier rounds have shown to be false."""

    pairs: Mapping[Pair, Contradiction]
    """Pairs that are not used any more."""
    first: frozenset[Pair]
    """Pairs of which only the first geometry is false. Their second one is used."""


NOTHING_REFUTED = Refuted({}, frozenset())


@dataclass(frozen=True)
class Round:
    """The models of one round, and what their checks say."""

    basis: Basis
    """What they follow."""
    models: "list[pycolmap.Reconstruction]"
    verdicts: dict[Pair, Verdict]
    checks: list[Checked | None]
    """For each model; None where it was not checked."""
    refuted: Refuted
    """What was known before this round."""

    def _done(self) -> list[Checked]:
        return [each for each in self.checks if each is not None]

    def opposed(self) -> dict[Pair, Contradiction]:
        """Pairs that agree with the models and whose own two photos contradict each other."""
        return {pair: why for each in self._done() for pair, why in each.refuted.items()}

    def suspected(self) -> dict[Pair, Contradiction]:
        """Other pairs that agree with the models and join groups that contradict each other."""
        return {pair: why for each in self._done() for pair, why in each.suspected.items()}

    def explained(self) -> set[Pair]:
        """Pairs that agree with the models."""
        return {pair for each in self._done() for pair in each.explained}

    def joining_opposed_groups(self, pairs: Iterable[Pair]) -> dict[Pair, Contradiction]:
        """Those of the pairs that join groups of photos that contradict each other."""
        found = [each for done in self._done() for each in done.check.contradictions]
        return {pair: each for pair in pairs for each in found if each.joined_by(pair)}

    def contradicted(self) -> int:
        """The number of points at which photos contradict each other."""
        return sum(c.contradicted for each in self._done() for c in each.check.contradictions)

    def contradicting(self) -> "Round":
        """The same round with only those models whose photos contradict each other."""
        red = [
            k
            for k, done in enumerate(self.checks)
            if done is not None and done.check.contradictions
        ]
        models, checks = ([column[k] for k in red] for column in (self.models, self.checks))
        return replace(self, models=models, checks=checks)

    def consistent_pairs(self) -> int:
        """The number of pairs of photos, matched or not, whose places nothing contradicts: those in
        the same part of a model."""
        sizes = [len(part) for each in self._done() for part in each.parts]
        return sum(size * (size - 1) // 2 for size in sizes)

    def checked_photos(self) -> set[str]:
        """The photos in models that were checked."""
        return {name for each in self._done() for name in each.check.photos()}

    def at_least_as_good_as(self, other: "Round") -> bool:
        """Compare the models: those that no photo contradicts first, then those with more photos.

        If photos contradict each other in both, the models can be told apart. What counts then is
        how many photos are in the same part, and last the number of contradictions. A round without
        a model that could be checked is not as good as another one.
        """
        if not self.checked_photos():
            return False
        if bool(self.contradicted()) != bool(other.contradicted()):
            return not self.contradicted()
        if self.contradicted():
            ours, theirs = self.consistent_pairs(), other.consistent_pairs()
            if ours != theirs:
                return ours > theirs
        ours, theirs = len(self.checked_photos()), len(other.checked_photos())
        if not nearly_equal(ours, theirs):
            return ours > theirs
        return self.contradicted() <= other.contradicted()


def best_of(made: Iterable[Round]) -> Round:
    """The best of some rounds; of rounds that are equally good, the last one."""
    return functools.reduce(
        lambda best, each: each if each.at_least_as_good_as(best) else best, made
    )
