"""Mappings of all photos: which pairs each trusts, what its check says, and which one is better.

The first mapping trusts the pairs on which most others agree (`jaxsfm.sfm.view_graph`). If its
photos contradict each other, a second one is made without the pairs that the check rejected, and
strong pairs have to agree with the others, too. If the photos are numbered in the order in which
they were taken, pairs of photos that follow each other come first in it
(`jaxsfm.sfm.photo_order`). If many photos were left out, the second one has the same pairs, and the
mapper does all that it can. There is no third one.
"""

import dataclasses
import itertools
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsfm.colmap.database import drop_pairs
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import Attempt, complete, run_mapper, with_all_points
from jaxsfm.colmap.reconstruction import registered
from jaxsfm.colmap.rigid_model import rigid_models
from jaxsfm.colmap.rigs import clear_rigs, have_common_centre, rigs_of_database
from jaxsfm.colmap.two_views import PairGeometry, keep_inliers, read_inliers
from jaxsfm.config import Config
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import Basis, Contradiction, ModelCheck
from jaxsfm.sfm.checker import Checker, VerifiedPairs
from jaxsfm.sfm.limits import TRUST
from jaxsfm.sfm.mapper_matches import mapper_matches
from jaxsfm.sfm.photo_order import follow, neighbours, ordered, orders
from jaxsfm.sfm.view_graph import Verdict, edge_weights, trusted_pairs

if TYPE_CHECKING:
    import pycolmap


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trust:
    """Which pairs a mapping is given, and how the mapper runs."""

    basis: Basis = "pairs"
    """What the trusted pairs follow."""
    verdicts: dict[Pair, Verdict] = dataclasses.field(default_factory=dict)
    """By pair. Pairs without a verdict are trusted."""
    thorough: bool = False
    """Whether the mapper makes no draft, but does all that COLMAP's own one does."""

    def dropped(self) -> set[Pair]:
        """The pairs that the mapper is not given."""
        return {pair for pair, verdict in self.verdicts.items() if not verdict.trusted}


@dataclasses.dataclass(frozen=True, kw_only=True)
class MappedModels:
    """The models of one mapping, and what their checks say."""

    trust: Trust
    database: Path
    """With the pairs that the mapping was given."""
    models: "list[pycolmap.Reconstruction]"
    """The one with most photos first."""
    checks: list[Checked | None]
    """For each model; None where it was not checked."""

    def contradicted(self) -> int:
        """The number of points at which photos contradict each other."""
        return sum(
            each.contradicted
            for done in self.checks
            if done is not None
            for each in done.check.contradictions
        )

    def is_inconsistent(self) -> bool:
        """Whether a model has parts that contradict each other, or that nothing holds together."""
        return any(done is not None and len(done.components) > 1 for done in self.checks)

    def rejected(self) -> dict[Pair, Contradiction]:
        """The pairs that joined photos which contradict each other.

        Pairs whose own two photos contradict each other come first. Others that join groups are
        rejected only if there is none of these: with them gone, the groups may be joined rightly.
        """
        done = [each for each in self.checks if each is not None]
        opposed = {pair: why for each in done for pair, why in each.rejected.items()}
        return opposed or {
            pair: why for each in done for pair, why in each.rejection_candidates.items()
        }

    def apart(self, following: set[Pair]) -> set[Pair]:
        """Those pairs of photos that follow each other that do not agree with their model."""
        inside = [each for each in self.checks if each is not None]
        return {
            pair
            for each in inside
            for pair in following - each.explained
            if each.check.photos() >= set(pair)
        }

    def consistent_pairs(self) -> int:
        """The number of pairs of photos, matched or not, whose places nothing contradicts.

        COLMAP's models share photos. A pair of photos that two models have counts once.
        """
        parts = [
            part
            for model, done in zip(self.models, self.checks, strict=True)
            for part in (done.components if done is not None else [registered(model)])
        ]
        inside: dict[str, set[int]] = {}
        for k, part in enumerate(parts):
            for name in part:
                inside.setdefault(name, set()).add(k)
        # Photos that are in the same parts are counted together.
        alike = Counter(frozenset(own) for own in inside.values())
        across = itertools.combinations(alike.items(), 2)
        return sum(count * (count - 1) // 2 for count in alike.values()) + sum(
            count * other for (own, count), (theirs, other) in across if own & theirs
        )

    def better_than(self, other: "MappedModels", following: set[Pair]) -> bool:
        """Whether these models are better. This is the only rule that compares two mappings.

        The models are better in which more pairs of photos have places that nothing contradicts.
        A photo that loses its place loses all its pairs, and so does a photo that others
        contradict. Of equal ones, those are better in which fewer photos disagree with the photo
        that was taken next.
        """
        ours, theirs = self.consistent_pairs(), other.consistent_pairs()
        if ours != theirs:
            return ours > theirs
        return len(self.apart(following)) < len(other.apart(following))


@dataclasses.dataclass(frozen=True, kw_only=True)
class MappingFigures:
    """What the mappings left beside the models."""

    verdicts: dict[Pair, Verdict]
    """Which pairs the mapper was given for the models, and which not. Empty if the view graph is
    switched off and no pair was rejected."""
    attempts: list[Attempt]
    """All runs of the mapper."""
    checks: list[ModelCheck | None]
    """For each model; None where it was not checked."""
    basis: Basis = "pairs"
    """What the models follow."""

    def misleading(self) -> set[Pair]:
        """Pairs that do not say where photos stand, because they were found to be false."""
        return {
            pair
            for pair, verdict in self.verdicts.items()
            if not verdict.trusted and (verdict.rejected or self.basis == "order")
        }


class Mapper:
    """Makes mappings from verified pairs, and has their models checked."""

    def __init__(self, given: VerifiedPairs, *, config: Config, options: MapOptions) -> None:
        """
        Args:
          config: its `view_graph`, `checked` and `refinement` switch those parts on. If models are
            refined, the mapper is given a share of the matches, of which it makes a draft.
        """
        self.given, self._config, self._options = given, config, options
        self._share = config.refinement is not None

    @property
    def _draft(self) -> MapOptions:
        return dataclasses.replace(self._options, draft=self._share)

    def trust_votes(self) -> Trust:
        """What the first mapping trusts."""
        if not self._config.view_graph:
            return Trust()
        return Trust(verdicts=trusted_pairs(self._geometries()))

    def trust_for_remapping(self, first: MappedModels) -> Trust | None:
        """What a second mapping trusts; None if a second one has no other pairs to go by.

        Args:
          first: the first mapping, against which something speaks.
        """
        rejected = first.rejected()
        left = {p: each for p, each in self._geometries().items() if p not in rejected}
        names = {name for pair in self.given.two_views for name in pair}
        found = orders(names)
        numbered = bool(found) and ordered(found, names)
        if not (rejected or numbered):
            return None
        links = follow(found, edge_weights(left)) if numbered else set[Pair]()
        verdicts = trusted_pairs(left, strict=True, first=links)
        verdicts |= {pair: _rejected(each) for pair, each in rejected.items()}
        return Trust(basis="order" if numbered else "pairs", verdicts=verdicts)

    def trust_thoroughly(self, first: MappedModels) -> Trust | None:
        """What a second mapping trusts if the first one left out photos; None if it left out few.

        The pairs are the same, but the mapper does all that it can.
        """
        dropped = first.trust.dropped()
        pairs = sorted(pair for pair in self.given.two_views if pair not in dropped)
        if not self._share or complete(first.models, pairs):
            return None
        return dataclasses.replace(first.trust, thorough=True)

    def map(
        self, trust: Trust, database: Path, on_image: Callable[[], None] = lambda: None
    ) -> MappedModels:
        """Map the trusted pairs, and check the models.

        Args:
          database: where to write the pairs.
          on_image: called for every image that the mapper registers.

        Raises:
          UserError: COLMAP fails.
        """
        shutil.copyfile(self.given.database, database)
        drop_pairs(database, sorted(trust.dropped()))
        options = self._options if trust.thorough else self._draft
        rigs = rigs_of_database(database)
        alone = rigs is not None and not (
            options.mapper == "incremental" and have_common_centre(rigs)
        )
        with tempfile.TemporaryDirectory(dir=database.parent) as scratch:
            source = database
            if self._share or alone:
                source = Path(scratch) / "mapper.db"
                shutil.copyfile(database, source)
            if self._share:
                keep_inliers(source, mapper_matches(read_inliers(source)))
            if alone:
                clear_rigs(source)
            models = run_mapper(source, options, on_image=on_image)
        models = rigid_models(models, database, self._options)
        checks = self.checker(database).check(models)
        return MappedModels(trust=trust, database=database, models=models, checks=checks)

    def checker(self, database: Path) -> Checker:
        """Checks models that were made from the pairs of a database.

        They are checked with the points of all matches of these pairs. The points are adjusted as
        those of a draft: the check asks only where they are missing.
        """
        whole: list[tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]] = []

        def with_points(model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
            if not self._share:
                return model
            for one, found in whole:
                if one is model:
                    return found
            whole.append((model, with_all_points(model, database, self._draft)))
            return whole[-1][1]

        return Checker(self.given, self._config, self._options.seed, with_points)

    def with_points_for_good(self, made: MappedModels) -> "list[pycolmap.Reconstruction]":
        """The models with the points of all matches of their pairs, if they are not refined."""
        if not self._share:
            return made.models
        return [with_all_points(model, made.database, self._options) for model in made.models]

    def following(self) -> set[Pair]:
        """The strong pairs of photos that follow each other by their names.

        Where a photographer walks on to another place, the last photo before and the first one
        after have a weak pair, which says nothing: photos 13 and 14 of Herz-Jesus-P25 have an
        edge weight of 0.0002, and all others that follow each other 0.7 to 1.
        """
        edge_weight = edge_weights(self._geometries())
        return {
            pair for pair in neighbours(edge_weight.keys()) if edge_weight[pair] >= TRUST.strong
        }

    def _geometries(self) -> dict[Pair, PairGeometry]:
        return {pair: view.geometry for pair, view in self.given.two_views.items()}


def _rejected(each: Contradiction) -> Verdict:
    return Verdict(
        trusted=False,
        rejected=True,
        edge_weight=0.0,
        rotation_error_deg=None,
        reason=(
            f"the photos it joins contradict each other: of {each.tested} points of one group, "
            f"{each.contradicted} are missing in the other"
        ),
    )
