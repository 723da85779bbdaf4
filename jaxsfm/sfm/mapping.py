"""From verified pairs to checked models: hypotheses about which pairs are right, and a choice.

Where photos contradict each other in a model, pairs that joined them are refuted, and the model is
made again without them. So other ways to join the groups of photos are tried until the photos agree
with one, or until no pair is left that joins the groups. The two hypotheses are described in
`jaxsfm.sfm.hypotheses`. The second is tried if something speaks against the first one. If both
stand, both models are returned. Models in which photos contradict each other to the end are taken
apart (`jaxsfm.sfm.told_apart`). Models that share photos are joined (`jaxsfm.sfm.joined_models`).
"""

import dataclasses
import logging
import tempfile
from collections.abc import Callable, Sequence, Set
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import Attempt
from jaxsfm.colmap.model_images import take_out
from jaxsfm.colmap.poses import model_poses
from jaxsfm.config import Config
from jaxsfm.io.kept_folders import Steps
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.common_places import SAME_SHARE, groups
from jaxsfm.sfm.check.model_check import MIN_VIEWS, Alternative, Basis, ModelCheck
from jaxsfm.sfm.checker import VerifiedPairs
from jaxsfm.sfm.hypotheses import by_order, by_votes
from jaxsfm.sfm.photo_order import neighbours, ordered, orders
from jaxsfm.sfm.round import Round
from jaxsfm.sfm.rounds import Rounds
from jaxsfm.sfm.view_graph import Verdict

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MappingFigures:
    """What the rounds left beside the models."""

    verdicts: dict[Pair, Verdict]
    """Which pairs the mapper was given in the round of the models, and which not. Empty if the view
    graph is switched off and no pair was refuted."""
    attempts: list[Attempt]
    """All runs of the mapper, in all rounds."""
    checks: list[ModelCheck | None]
    """For each model; None where it was not checked."""
    basis: Basis = "pairs"
    """What the models follow."""
    cut_short: bool = False
    """Whether more rounds may give better models (`jaxsfm.sfm.hypotheses.Voted`)."""

    def misleading(self) -> set[Pair]:
        """Pairs that do not say where photos stand, because the rounds found them to be false."""
        return {
            pair
            for pair, verdict in self.verdicts.items()
            if not verdict.trusted and (verdict.refuted or self.basis == "order")
        }


class Mapped(NamedTuple):
    """The outcome of mapping."""

    models: "list[pycolmap.Reconstruction]"
    """The one with most images first; empty if there is none. If they are to be refined, they have
    the points of the matches that the mapper was given."""
    figures: MappingFigures
    alternative: "list[pycolmap.Reconstruction]"
    """Models that join the photos in another way; empty if there is no other way."""


def build_checked_models(
    given: VerifiedPairs,
    database: Path,
    *,
    config: Config,
    options: MapOptions,
    on_image: Callable[[], None] = lambda: None,
    go_on: Callable[[], bool] = lambda: True,
    steps: Steps | None = None,
) -> Mapped:
    """Map verified pairs until no photo contradicts the others, with two hypotheses.

    If photos still contradict each other after the last round, the parts of the best models are
    returned, and their checks say so; the alternative is then what they are parts of. If nothing
    speaks against the models only because an earlier one fell apart when pairs were left out, the
    checks say so, too. A round that leaves no model to check does not count.

    Args:
      database: where to write the pairs that the models were made from.
      config: its `view_graph` and `checked` switch these parts on.
      on_image: called for every image that the mapper registers.
      go_on: whether to go on, if photos still contradict each other after the first rounds. If not,
        the best of these is returned.
      steps: where models and checks are kept until all rounds are made; None: nowhere.
    """
    following = neighbours(given.two_views.keys())
    with tempfile.TemporaryDirectory(dir=database.parent) as scratch:
        rounds = Rounds(
            given,
            database,
            Path(scratch),
            config=config,
            options=options,
            on_image=on_image,
            steps=steps,
        )
        voted = by_votes(rounds, view_graph=config.view_graph, go_on=go_on)
        best, other = rounds.joined(voted.best), None
        checks, complete = _checks(best, following, rounds.fallen_apart(best)), False
        if green(checks):
            checks, complete = rounds.with_second_places(best, checks), True
        names = {name for pair in given.two_views for name in pair}
        found = orders(names)
        if found and ordered(found, names) and not green(checks):
            logger.info("something speaks against the model; following the order of the names")
            rounds.doubt(checks)
            other = rounds.joined(by_order(rounds, found))
            if other.at_least_as_good_as(best):
                best, other = other, best
                checks, complete = _checks(best, following, rounds.fallen_apart(best)), False
        rounds.go_back_to(best)
        whole, parts = best, []
        red = best.contradicted() > 0
        if red:
            best, parts = rounds.told_apart(best)
            best = rounds.joined(best)
            checks = _checks(best, following, _still_apart(parts, best))
        checks = _without_strays(best, checks, following)
        if not complete:
            checks = rounds.with_second_places(best, checks)
        alternative = []
        if parts and checks[0] is not None:
            whole = whole.contradicting()
            checks[0] = dataclasses.replace(checks[0], alternative=_untold(whole, checks[0]))
            alternative = rounds.with_all_points(whole)
        elif other is not None and checks[0] is not None and _stands(other, red=red):
            told = _alternative(best, other)
            if told is not None:
                checks[0] = dataclasses.replace(checks[0], alternative=told)
                alternative = rounds.with_all_points(other)
    figures = MappingFigures(
        verdicts=best.verdicts,
        attempts=rounds.attempts,
        checks=checks,
        basis=best.basis,
        cut_short=voted.cut_short,
    )
    return Mapped(best.models, figures, alternative)


def green(checks: Sequence[ModelCheck | None]) -> bool:
    """Whether nothing is known to speak against any of the models."""
    return all(check is None or check.verdict == "green" for check in checks)


def _checks(
    made: Round, following: Set[Pair], parts: Sequence[list[str]] = ()
) -> list[ModelCheck | None]:
    """The checks of the models, with the neighbours in an order that do not agree with them.

    Args:
      parts: those that were told apart.
    """

    def with_neighbours(each: Checked) -> ModelCheck:
        inside = each.check.photos()
        apart = [list(p) for p in sorted(following - each.explained) if inside >= set(p)]
        return dataclasses.replace(each.check, apart=apart, told_apart=list(parts))

    return [each and with_neighbours(each) for each in made.checks]


def _still_apart(parts: Sequence[list[str]], made: Round) -> list[list[str]]:
    """The parts that were told apart, after models were joined: those whose photos are in one model
    are one. There are none if all are one."""
    models = [each.check.photos() for each in made.checks if each is not None]
    joined: dict[int, list[str]] = {}
    for k, part in enumerate(parts):
        inside = [i for i, photos in enumerate(models) if photos.issuperset(part)]
        joined.setdefault(inside[0] if inside else -1 - k, []).extend(part)
    found = sorted((sorted(set(part)) for part in joined.values()), key=lambda p: (-len(p), p))
    return found if len(found) > 1 else []


def _without_strays(
    made: Round, checks: Sequence[ModelCheck | None], following: Set[Pair]
) -> list[ModelCheck | None]:
    """Take photos out of the models with which none of their neighbours there agrees.

    A photo at the end of a model is often one whose pair with the next photo takes one wall for
    another. Where photos contradict each other, nothing is taken out: neighbours may be the wrong
    ones.

    Returns:
      the checks of the models that remain.
    """
    told = list(checks)
    for k, (model, done, check) in enumerate(zip(made.models, made.checks, checks, strict=True)):
        if done is None or check is None or check.contradictions:
            continue
        beside = {name for pair in following & done.explained for name in pair}
        strays = {name for pair in following & done.against for name in pair} - beside
        if strays and sum(map(len, check.groups)) - len(strays) >= MIN_VIEWS:
            take_out(model, strays)
            told[k] = check.without(strays)
    return told


def _stands(other: Round, *, red: bool) -> bool:
    """Whether other models are worth showing: not if photos contradict these ones alone.

    Args:
      red: whether photos contradict the best models too.
    """
    return bool(other.checked_photos()) and (red or not other.contradicted())


def _untold(whole: Round, part: ModelCheck) -> Alternative:
    """What the largest model that was told apart says of the largest part.

    Args:
      whole: the round, with the models that were told apart alone.
    """
    assert whole.checks[0] is not None
    before, now = (check.photos() for check in (whole.checks[0].check, part))
    return Alternative(
        basis=whole.basis,
        images=len(before),
        elsewhere=sorted(before - now),
        contradicted=whole.contradicted(),
        whole=True,
    )


def _alternative(best: Round, other: Round) -> Alternative | None:
    """What an alternative says of the best model; None if the two agree."""
    ours, theirs = (model_poses(made.models[0]) for made in (best, other))
    common = {name: pose for name, pose in ours.items() if name in theirs}
    if not common:
        return None
    same, *elsewhere = groups(common, theirs)
    if len(same) >= SAME_SHARE * len(common):
        return None
    return Alternative(
        basis=other.basis,
        images=len(theirs),
        elsewhere=sorted(name for group in elsewhere for name in group),
        contradicted=other.contradicted(),
    )
