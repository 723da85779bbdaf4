"""From verified pairs to checked models: hypotheses about which pairs are right, and a choice.

Where photos contradict each other in a model, pairs that joined them are refuted, and the model is
made again without them. So other ways to join the groups of photos are tried until the photos agree
with one, or until no pair is left that joins the groups. There are two hypotheses. The first is
that the pairs on which most others agree are right (`jaxsfm.sfm.view_graph`). The second is that
photos that were taken one after the other belong together (`jaxsfm.sfm.photo_order`). It is tried
if something speaks against the first one. If both stand, both models are returned.
"""

import dataclasses
import logging
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.colmap.mapper import Attempt, MapOptions
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.two_views import PairGeometry
from jaxsfm.config import Config
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.common_places import SAME_SHARE, groups
from jaxsfm.sfm.check.model_check import Alternative, Basis, ModelCheck
from jaxsfm.sfm.photo_order import Order, follow, neighbours, orders
from jaxsfm.sfm.rounds import NOTHING_REFUTED, Refuted, Round, Rounds, VerifiedPairs
from jaxsfm.sfm.view_graph import (
    TOLERANCE_DEG,
    Verdict,
    rotation_angle_deg,
    strengths,
    trusted_pairs,
)

if TYPE_CHECKING:
    import pycolmap

MAX_ROUNDS = 4
"""At most so many times the pairs are mapped for a hypothesis. A model without contradictions takes
one round, the courtyard of castle-P19 at 800 px and a rendered room take two. Each takes as long as
the first."""
SUDDEN = 3.0
"""A link turns the camera suddenly if its angle is so many times the median of all links. On the
corners of rendered boxes, wrong geometries turn it by 70 deg or more, and right ones by 20."""

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


class Mapped(NamedTuple):
    """The outcome of mapping."""

    models: "list[pycolmap.Reconstruction]"
    """The one with most images first; empty if there is none."""
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
) -> Mapped:
    """Map verified pairs until no photo contradicts the others, in at most `MAX_ROUNDS` rounds.

    If photos still contradict each other after the last round, the best models are returned all the
    same, and their checks say so. A round that leaves no model to check does not count.

    Args:
      database: where to write the pairs that the models were made from.
      config: its `view_graph` and `checked` switch these parts on.
      on_image: called for every image that the mapper registers.
    """
    with tempfile.TemporaryDirectory(dir=database.parent) as scratch:
        rounds = Rounds(given, Path(scratch), config=config, options=options, on_image=on_image)
        best = by_votes(rounds, view_graph=config.view_graph)
        basis, other = "pairs", None
        found = orders({name for pair in given.two_views for name in pair})
        if found and best.checked_photos() and _in_doubt(best, found, given):
            logger.info("something speaks against the model; following the order of the names")
            other = by_order(rounds, found)
            if not best.is_green() and other.at_least_as_good_as(best):
                best, other, basis = other, best, "order"
        shutil.copyfile(best.database, database)
    checks = [each and each.check for each in best.checks]
    alternative = []
    if other is not None and checks[0] is not None and _stands(other, beside=best):
        told = _alternative(best, other, "pairs" if basis == "order" else "order")
        if told is not None:
            checks[0] = dataclasses.replace(checks[0], alternative=told)
            alternative = other.models
    figures = MappingFigures(verdicts=best.verdicts, attempts=rounds.attempts, checks=checks)
    return Mapped(best.models, figures, alternative)


def by_votes(rounds: Rounds, *, view_graph: bool) -> Round:
    """The best round of the hypothesis that the pairs on which most others agree are right.

    Pairs that were left out are taken back in one more round, if they agree with models in which no
    photo contradicts another.
    """

    def vote(geometries: Mapping[Pair, PairGeometry], refuted: bool) -> dict[Pair, Verdict]:
        return trusted_pairs(geometries, strict=refuted) if view_graph else {}

    best = made = rounds.make(vote, NOTHING_REFUTED)
    for _ in range(MAX_ROUNDS - 1):
        refuted = _outvoted(rounds, made)
        if refuted == made.refuted:
            break
        logger.info("photos contradict each other; mapping again without the pairs that join them")
        made = rounds.make(vote, refuted)
        if not made.checked_photos():  # these pairs were all that held photos together
            break
        if made.at_least_as_good_as(best):
            best = made
    if (back := best.refuted.pairs.keys() & best.explained()) and not best.contradicted():
        left = {pair: why for pair, why in best.refuted.pairs.items() if pair not in back}
        again = rounds.make(vote, Refuted(left, best.refuted.first))
        if not again.contradicted() and again.checked_photos() >= best.checked_photos():
            best = again
    return best


def _outvoted(rounds: Rounds, made: Round) -> Refuted:
    """What is refuted after a round of `by_votes`.

    Pairs that are suspected because of their groups are left out only if no pair is refuted by its
    own two photos: with these gone, the groups may be joined rightly.
    """
    if against := made.opposed():
        return rounds.without(made.refuted, against)
    return made.refuted._replace(pairs={**made.refuted.pairs, **made.suspected()})


def by_order(rounds: Rounds, found: list[Order]) -> Round:
    """The best round of the hypothesis that photos taken one after the other belong together.

    The fewest pairs that follow the order make a first model. All pairs that agree with it are
    added for a second one. If its photos contradict each other, both are made again.
    """

    def following(agreeing: set[Pair]):
        def verdicts(geometries: Mapping[Pair, PairGeometry], _: bool) -> dict[Pair, Verdict]:
            strength = strengths(geometries)
            taken = follow(found, strength) | (agreeing & strength.keys())
            return {pair: _ordered(strength[pair], pair in taken) for pair in strength}

        return verdicts

    refuted, best = NOTHING_REFUTED, None
    for _ in range(MAX_ROUNDS // 2):
        chain = rounds.make(following(set()), refuted)
        grown = rounds.make(following(chain.explained()), refuted)
        for made in (chain, grown):
            if best is None or made.at_least_as_good_as(best):
                best = made
        links = [pair for pair, verdict in chain.verdicts.items() if verdict.trusted]
        against = grown.joining_opposed_groups(links)
        sudden = rounds.with_seconds(_sudden(links, rounds.given) - refuted.first)
        if not against and not sudden:
            break
        refuted = rounds.without(refuted, against)
        refuted = refuted._replace(first=refuted.first | (sudden - against.keys()))
    assert best is not None
    return best


def _sudden(links: list[Pair], given: VerifiedPairs) -> set[Pair]:
    """Links whose geometry turns the camera much further than the others do.

    Photos that follow each other at the corner of a building with equal walls show both walls. The
    pair then takes one wall for the other, and its second geometry is the right one.
    """
    turns = {
        pair: float(rotation_angle_deg(rotation, np.eye(3)))
        for pair in links
        if (rotation := given.two_views[pair].geometry.rotation) is not None
    }
    most = SUDDEN * float(np.median(list(turns.values()))) if turns else 0.0
    return {pair for pair, turn in turns.items() if turn > max(most, TOLERANCE_DEG)}


def _ordered(strength: float, taken: bool) -> Verdict:
    return Verdict(
        trusted=taken,
        strength=strength,
        rotation_error_deg=None,
        reason="" if taken else "it does not agree with the order of the photos' names",
    )


def _in_doubt(made: Round, found: list[Order], given: VerifiedPairs) -> bool:
    """Whether something speaks against models, or photos that follow each other do not agree."""
    if not made.is_green():
        return True
    inside, verified = made.checked_photos(), given.two_views.keys()
    following = {pair for pair in neighbours(found) & verified if inside >= set(pair)}
    return bool(following - made.explained())


def _stands(other: Round, *, beside: Round) -> bool:
    """Whether photos contradict the other models no more than the chosen ones."""
    return bool(other.checked_photos()) and (beside.contradicted() > 0 or not other.contradicted())


def _alternative(best: Round, other: Round, basis: Basis) -> Alternative | None:
    """What an alternative says of the best model; None if the two agree."""
    ours, theirs = (model_poses(made.models[0]) for made in (best, other))
    common = {name: pose for name, pose in ours.items() if name in theirs}
    if not common:
        return None
    same, *elsewhere = groups(common, theirs)
    if len(same) >= SAME_SHARE * len(common):
        return None
    return Alternative(
        basis=basis,
        images=len(theirs),
        elsewhere=sorted(name for group in elsewhere for name in group),
        contradicted=other.contradicted(),
    )
