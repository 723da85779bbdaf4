"""Rounds of mapping: the pairs that a hypothesis trusts, COLMAP's mapper and the check.

A hypothesis says which pairs are right. Each of its rounds has fewer pairs than the one before: the
check has refuted those that joined photos that contradict each other.
"""

import dataclasses
import functools
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.database import copy_geometries, drop_pairs, keep_outliers
from jaxsfm.colmap.mapper import Attempt, MapOptions, build_models
from jaxsfm.colmap.two_views import PairGeometry, TwoView, read_two_views, verify
from jaxsfm.config import Config
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import Basis, Contradiction, ModelCheck
from jaxsfm.sfm.checker import Checker, VerifiedPairs
from jaxsfm.sfm.told_apart import told_apart
from jaxsfm.sfm.view_graph import Verdict

if TYPE_CHECKING:
    import pycolmap

FEWER = 0.1
"""A model is smaller than another one if it has fewer photos by more than this share of them."""


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

    def consistent_pairs(self) -> int:
        """The number of pairs of photos, matched or not, whose places nothing contradicts: those in
        the same part of a model."""
        sizes = [len(part) for each in self._done() for part in each.parts]
        return sum(size * (size - 1) // 2 for size in sizes)

    def checked_photos(self) -> set[str]:
        """The photos in models that were checked."""
        return {name for each in self._done() for group in each.check.groups for name in group}

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
        if abs(ours - theirs) > FEWER * max(ours, theirs):
            return ours > theirs
        return self.contradicted() <= other.contradicted()


def best_of(made: Iterable[Round]) -> Round:
    """The best of some rounds; of rounds that are equally good, the last one."""
    return functools.reduce(
        lambda best, each: each if each.at_least_as_good_as(best) else best, made
    )


class Rounds:
    """Makes rounds from verified pairs.

    `database` has the pairs of the round that came last. The second geometries are in the folder
    `scratch`.
    """

    def __init__(
        self,
        given: VerifiedPairs,
        database: Path,
        scratch: Path,
        *,
        config: Config,
        options: MapOptions,
        on_image: Callable[[], None] = lambda: None,
    ) -> None:
        self.given, self._database = given, database
        self._second_database = scratch / "second.db"
        self._options, self._on_image = options, on_image
        self._checker = Checker(given, config, options.seed)
        self.attempts: list[Attempt] = []
        """All runs of the mapper, in all rounds."""
        self._asked: set[Pair] = set()
        """Pairs whose second geometry was looked for."""
        self._seconds: dict[Pair, TwoView] = {}
        """The second geometries that were found."""

    def make(self, hypothesis: Hypothesis, refuted: Refuted) -> Round:
        """Map the pairs that a hypothesis trusts, and check the models."""
        views = {pair: v for pair, v in self.given.two_views.items() if pair not in refuted.pairs}
        views |= {pair: self._seconds[pair] for pair in refuted.first}
        known = bool(refuted.pairs or refuted.first)
        verdicts = hypothesis.judge({pair: view.geometry for pair, view in views.items()}, known)
        verdicts |= {pair: _refuted(each) for pair, each in refuted.pairs.items()}
        dropped = self._write_pairs(verdicts, refuted)
        trusted = {pair: view for pair, view in views.items() if pair not in dropped}
        models, attempts = build_models(
            self._database, trusted, self._options, on_image=self._on_image
        )
        self.attempts += attempts
        checks = self._checker.check(models, refuted.pairs)
        self._last = Round(hypothesis.basis, models, verdicts, checks, refuted)
        return self._last

    def told_apart(self, made: Round) -> tuple[Round, list[list[str]]]:
        """The models of a round, taken apart where photos contradict each other; their parts."""
        found = told_apart(made.models, made.checks, self._checker, self._options)
        whole = dataclasses.replace(made, models=found.models, checks=found.checks)
        return whole, found.told_apart

    def with_second_places(
        self, made: Round, checks: Sequence[ModelCheck | None]
    ) -> list[ModelCheck | None]:
        """Checks of the models of a round, with the second places of their photos."""
        return [
            done and check and self._checker.with_second_places(model, done, check)
            for model, done, check in zip(made.models, made.checks, checks, strict=True)
        ]

    def go_back_to(self, made: Round) -> None:
        """Make the database that of a round."""
        if made is not self._last:
            self._write_pairs(made.verdicts, made.refuted)
            self._last = made

    def _write_pairs(self, verdicts: Mapping[Pair, Verdict], refuted: Refuted) -> set[Pair]:
        """Write the database without the pairs that are not trusted; returns these."""
        dropped = {pair for pair, verdict in verdicts.items() if not verdict.trusted}
        shutil.copyfile(self.given.database, self._database)
        if refuted.first:
            copy_geometries(self._second_database, self._database, sorted(refuted.first))
        drop_pairs(self._database, sorted(dropped))
        return dropped

    def without(self, before: Refuted, against: Mapping[Pair, Contradiction]) -> Refuted:
        """Refute pairs: the first geometry of a pair, and the whole pair the second time.

        The matches of a pair may hold two geometries, where its photos show equal walls and a part
        that is common to both. COLMAP verifies the one with more matches.
        """
        again = self.with_seconds(against.keys() - before.first)
        gone = {pair: why for pair, why in against.items() if pair not in again}
        return Refuted({**before.pairs, **gone}, (before.first | again) - gone.keys())

    def with_seconds(self, pairs: Collection[Pair]) -> set[Pair]:
        """Those of the pairs that have a second geometry.

        It is looked for among the matches that do not agree with the first one.
        """
        new, path = sorted(set(pairs) - self._asked), self._second_database
        if new:
            if not path.exists():
                shutil.copyfile(self.given.database, path)
            keep_outliers(path, new)
            verify(path, self._options.verification())
            found = read_two_views(path)
            self._seconds |= {pair: found[pair] for pair in new if pair in found}
            self._asked |= set(new)
        return set(pairs) & self._seconds.keys()


def _refuted(each: Contradiction) -> Verdict:
    return Verdict(
        trusted=False,
        refuted=True,
        strength=0.0,
        rotation_error_deg=None,
        reason=(
            f"the photos it joins contradict each other: of {each.tested} points of one group, "
            f"{each.contradicted} are missing in the other"
        ),
    )
