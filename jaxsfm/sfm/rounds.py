"""Makes rounds of mapping: it gives pairs to the mapper, and has the models checked."""

import dataclasses
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsfm.colmap.database import copy_geometries, drop_pairs, keep_outliers
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import Attempt
from jaxsfm.colmap.model_images import fingerprint
from jaxsfm.colmap.two_views import TwoView, read_two_views, verify
from jaxsfm.config import Config
from jaxsfm.io.hashes import rows_sha256
from jaxsfm.io.kept_folders import Steps
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.check_files import read_outcomes, write_outcomes
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import Contradiction, ModelCheck
from jaxsfm.sfm.checker import Checker, VerifiedPairs
from jaxsfm.sfm.joined_models import Joiner
from jaxsfm.sfm.mapper_runs import MapperRuns
from jaxsfm.sfm.round import FEWER, Hypothesis, Refuted, Round
from jaxsfm.sfm.told_apart import told_apart
from jaxsfm.sfm.view_graph import Verdict

if TYPE_CHECKING:
    import pycolmap

OUTCOMES = "outcomes.json"
"""The file with the outcomes of kept checks."""


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
        steps: Steps | None = None,
    ) -> None:
        """
        Args:
          steps: where models and checks of rounds are kept until all rounds are made; None:
            nowhere.
        """
        self.given, self._database = given, database
        self._second_database = scratch / "second.db"
        self._options = options
        self._mapper = MapperRuns(
            database,
            scratch,
            options,
            share=config.refinement is not None,
            on_image=on_image,
            steps=steps,
        )
        self._steps = steps
        self._checker = Checker(given, config, options.seed, self._mapper.with_all_points)
        self._asked: set[Pair] = set()
        """Pairs whose second geometry was looked for."""
        self._seconds: dict[Pair, TwoView] = {}
        """The second geometries that were found."""
        self._doubted: list[set[str]] = []
        """The photos of each model that something spoke against, in all rounds."""

    @property
    def attempts(self) -> list[Attempt]:
        """All runs of the mapper, in all rounds."""
        return self._mapper.attempts

    def make(self, hypothesis: Hypothesis, refuted: Refuted) -> Round:
        """Map the pairs that a hypothesis trusts, and check the models.

        If images are left out, the mapper is started again. This takes two more runs, and is not
        done for models in which photos contradict each other, which are made again anyway.
        """
        views = {pair: v for pair, v in self.given.two_views.items() if pair not in refuted.pairs}
        views |= {pair: self._seconds[pair] for pair in refuted.first}
        known = bool(refuted.pairs or refuted.first)
        verdicts = hypothesis.judge({pair: view.geometry for pair, view in views.items()}, known)
        verdicts |= {pair: _refuted(each) for pair, each in refuted.pairs.items()}
        dropped = self._write_pairs(verdicts, refuted)
        trusted = {pair: view for pair, view in views.items() if pair not in dropped}
        made = self._mapper.first()
        checks = self._checked(made.models, refuted.pairs)
        if not any(each and each.check.contradictions for each in checks):
            more = self._mapper.with_left_out_images(made, trusted)
            if more is not made:
                made, checks = more, self._checked(more.models, refuted.pairs)
        self._last = Round(hypothesis.basis, made.models, verdicts, checks, refuted)
        self.doubt(each and each.check for each in checks)
        return self._last

    def _checked(
        self, models: "Sequence[pycolmap.Reconstruction]", refuted: Collection[Pair]
    ) -> list[Checked | None]:
        """The checks of models, which may have been made before."""
        if self._steps is None:
            return self._checker.check(models, refuted)
        about = [
            [fingerprint(model) for model in models],
            rows_sha256(self._database),
            [list(pair) for pair in sorted(refuted)],
        ]
        folder = self._steps.kept(
            "check",
            about,
            lambda fresh: write_outcomes(fresh / OUTCOMES, self._checker.check(models, refuted)),
        )
        return read_outcomes(folder / OUTCOMES)

    def doubt(self, checks: Iterable[ModelCheck | None]) -> None:
        """Remember the models that something speaks against (`fallen_apart`)."""
        self._doubted += [each.photos() for each in checks if each and each.verdict != "green"]

    def fallen_apart(self, made: Round) -> list[list[str]]:
        """Photos that were in one model of an earlier round, which something spoke against, and
        that no model of this round has together; the largest group first. There are none if photos
        still contradict each other.

        The rounds between have only left out pairs. If nothing else joins the photos, then nothing
        says that the pairs that are left are right, as they come from the same repeated walls.
        """
        if made.contradicted():
            return []
        now = [each.check.photos() for each in made.checks if each is not None]
        for before in sorted(self._doubted, key=len, reverse=True):
            parts = sorted((before & photos for photos in now), key=lambda part: -len(part))
            if not parts or len(parts[0]) < (1 - FEWER) * len(before):
                alone = before.difference(*parts)
                return [*(sorted(p) for p in parts if p), *([name] for name in sorted(alone))]
        return []

    def told_apart(self, made: Round) -> tuple[Round, list[list[str]]]:
        """The models of a round, taken apart where photos contradict each other; their parts."""
        self.go_back_to(made)
        found = told_apart(made.models, made.checks, self._checker, self._options)
        whole = dataclasses.replace(made, models=found.models, checks=found.checks)
        return whole, found.told_apart

    def joined(self, made: Round) -> Round:
        """The models of a round, joined where they share photos; the same round if none are.

        Where photos contradict each other, the models are told apart first.
        """
        if len(made.models) < 2 or made.contradicted():
            return made
        self.go_back_to(made)
        joiner = Joiner(self._checker, self._options, self._mapper.as_mapped)
        found = joiner.join(list(zip(made.models, made.checks, strict=True)))
        if len(found) == len(made.models):
            return made
        models, checks = map(list, zip(*found, strict=True))
        return dataclasses.replace(made, models=models, checks=checks)

    def with_second_places(
        self, made: Round, checks: Sequence[ModelCheck | None]
    ) -> list[ModelCheck | None]:
        """Checks of the models of a round, with the second places of their photos."""
        self.go_back_to(made)
        return [
            done and check and self._checker.with_second_places(model, done, check)
            for model, done, check in zip(made.models, made.checks, checks, strict=True)
        ]

    def go_back_to(self, made: Round) -> None:
        """Make the database that of a round."""
        if made.verdicts != self._last.verdicts or made.refuted != self._last.refuted:
            self._write_pairs(made.verdicts, made.refuted)
            self._last = made

    def with_all_points(self, made: Round) -> "list[pycolmap.Reconstruction]":
        """The models of a round with the points of all matches of its pairs, not to be refined."""
        before = self._last
        self.go_back_to(made)
        whole = [self._mapper.with_all_points(model, final=True) for model in made.models]
        self.go_back_to(before)
        return whole

    def _write_pairs(self, verdicts: Mapping[Pair, Verdict], refuted: Refuted) -> set[Pair]:
        """Write the database without the pairs that are not trusted; returns these."""
        dropped = {pair for pair, verdict in verdicts.items() if not verdict.trusted}
        shutil.copyfile(self.given.database, self._database)
        if refuted.first:
            copy_geometries(self._second_database, self._database, sorted(refuted.first))
        drop_pairs(self._database, sorted(dropped))
        self._mapper.database_changed()
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
