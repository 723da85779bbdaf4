"""Two hypotheses about which pairs are right, and the best models that follow from each.

The first hypothesis is that the pairs on which most others agree are right
(`jaxsfm.sfm.view_graph`). The second is that photos that were taken one after the other belong
together (`jaxsfm.sfm.photo_order`). Pairs that join photos which contradict each other are refuted
in rounds.
"""

import logging
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.two_views import PairGeometry
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.checker import VerifiedPairs
from jaxsfm.sfm.photo_order import Order, follow
from jaxsfm.sfm.round import NOTHING_REFUTED, Hypothesis, Refuted, Round, best_of
from jaxsfm.sfm.rounds import Rounds
from jaxsfm.sfm.view_graph import (
    TOLERANCE_DEG,
    Verdict,
    rotation_angle_deg,
    strengths,
    trusted_pairs,
)

MAX_ROUNDS = 4
"""At most so many times the pairs are mapped for a hypothesis. A model without contradictions takes
one round, the courtyard of castle-P19 at 800 px and a rendered room take two. Each takes as long as
the first."""
ROUNDS_BEFORE_ASKING = 2
"""After so many rounds in which photos contradict each other, it is asked whether to go on
(`Voted.cut_short`)."""
WORSE = 2 / 3
"""Rounds end if photos still contradict each other and the places of fewer pairs of photos are
consistent than this share of those of the best round. On *statue*, the first round has 1519 such
pairs, and the next ones have 959, 873 and 1013: right pairs were refuted. In eight rendered scenes
and on castle-P19, no better round followed one below three quarters of the best."""
SUDDEN = 3.0
"""A link turns the camera suddenly if its angle is so many times the median of all links. On the
corners of rendered boxes, wrong geometries turn it by 70 deg or more, and right ones by 20."""

logger = logging.getLogger("jaxsfm")


class Voted(NamedTuple):
    """The outcome of `by_votes`."""

    best: Round
    cut_short: bool
    """Whether photos contradict each other and there were no more rounds, because the photos can be
    matched in another way, which promises more."""


def by_votes(
    rounds: Rounds, *, view_graph: bool, go_on: Callable[[], bool] = lambda: True
) -> Voted:
    """The best round of the hypothesis that the pairs on which most others agree are right.

    Pairs that were left out are taken back in one more round, if they agree with models in which no
    photo contradicts another.

    Args:
      go_on: whether to go on, if photos still contradict each other after the first rounds.
    """

    def judge(geometries: Mapping[Pair, PairGeometry], refuted: bool) -> dict[Pair, Verdict]:
        return trusted_pairs(geometries, strict=refuted) if view_graph else {}

    vote = Hypothesis("pairs", judge)
    best, cut_short = (made := rounds.make(vote, NOTHING_REFUTED)), False
    for number in range(1, MAX_ROUNDS):
        refuted = _outvoted(rounds, made)
        if refuted == made.refuted:
            break
        if number == ROUNDS_BEFORE_ASKING and (cut_short := not go_on()):
            break
        logger.info("photos contradict each other; mapping again without the pairs that join them")
        made = rounds.make(vote, refuted)
        if not made.checked_photos():  # these pairs were all that held photos together
            break
        if made.contradicted() and made.consistent_pairs() < WORSE * best.consistent_pairs():
            break
        best = best_of([best, made])
    if (back := best.refuted.pairs.keys() & best.explained()) and not best.contradicted():
        left = {pair: why for pair, why in best.refuted.pairs.items() if pair not in back}
        again = rounds.make(vote, Refuted(left, best.refuted.first))
        if not again.contradicted() and again.checked_photos() >= best.checked_photos():
            best = again
    return Voted(best, cut_short)


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

    The fewest pairs that follow the order, the *links*, make a first model. All pairs that agree
    with it are added for a second one. Both are made again without the geometries of links that
    join photos which contradict each other, or that turn the camera suddenly.
    """

    def following(agreeing: set[Pair]) -> Hypothesis:
        def judge(geometries: Mapping[Pair, PairGeometry], _: bool) -> dict[Pair, Verdict]:
            strength = strengths(geometries)
            taken = follow(found, strength) | (agreeing & strength.keys())
            return {pair: _ordered(strength[pair], pair in taken) for pair in strength}

        return Hypothesis("order", judge)

    refuted, tried = NOTHING_REFUTED, []
    while True:
        chain = rounds.make(following(set()), refuted)
        grown = rounds.make(following(chain.explained()), refuted)
        tried += [chain, grown]
        if len(tried) >= MAX_ROUNDS:
            break
        links = {pair for pair, verdict in chain.verdicts.items() if verdict.trusted}
        refuted = _without_links(rounds, grown, links)
        if refuted == grown.refuted:
            break
    return best_of(tried)


def _without_links(rounds: Rounds, grown: Round, links: set[Pair]) -> Refuted:
    """What is refuted after two rounds of `by_order`."""
    against = grown.joining_opposed_groups(links)
    refuted = rounds.without(grown.refuted, against)
    sudden = _sudden(links, rounds.given) - against.keys() - refuted.first
    return refuted._replace(first=refuted.first | rounds.with_seconds(sudden))


def _sudden(links: set[Pair], given: VerifiedPairs) -> set[Pair]:
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
