"""From verified pairs to checked models: hypotheses about which pairs are right, and a choice.

Where photos contradict each other in a model, pairs that joined them are refuted, and the model is
made again without them. So other ways to join the groups of photos are tried until the photos agree
with one, or until no pair is left that joins the groups. The two hypotheses are described in
`jaxsfm.sfm.hypotheses`. The second is tried if something speaks against the first one. If both
stand, both models are returned.
"""

import dataclasses
import logging
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.mapper import Attempt, MapOptions
from jaxsfm.colmap.poses import model_poses
from jaxsfm.config import Config
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.common_places import SAME_SHARE, groups
from jaxsfm.sfm.check.model_check import Alternative, Basis, ModelCheck
from jaxsfm.sfm.hypotheses import by_order, by_votes
from jaxsfm.sfm.photo_order import Order, neighbours, orders
from jaxsfm.sfm.rounds import Round, Rounds, VerifiedPairs
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
    """Map verified pairs until no photo contradicts the others, with two hypotheses.

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
            if other.at_least_as_good_as(best):
                best, other, basis = other, best, "order"
        shutil.copyfile(best.database, database)
    checks = [each and each.check for each in best.checks]
    alternative = []
    if other is not None and checks[0] is not None and _stands(other, beside=best, basis=basis):
        told = _alternative(best, other, "pairs" if basis == "order" else "order")
        if told is not None:
            checks[0] = dataclasses.replace(checks[0], alternative=told)
            alternative = other.models
    figures = MappingFigures(verdicts=best.verdicts, attempts=rounds.attempts, checks=checks)
    return Mapped(best.models, figures, alternative)


def _in_doubt(made: Round, found: list[Order], given: VerifiedPairs) -> bool:
    """Whether something speaks against models, or photos that follow each other do not agree."""
    if not made.is_green():
        return True
    inside, verified = made.checked_photos(), given.two_views.keys()
    following = {pair for pair in neighbours(found) & verified if inside >= set(pair)}
    return bool(following - made.explained())


def _stands(other: Round, *, beside: Round, basis: Basis) -> bool:
    """Whether other models are worth showing beside the best ones, which follow `basis`.

    If photos contradict the other models and not the best ones, the best ones stand alone. There is
    one exception: a green model that follows the pairs, although photos that follow each other do
    not agree with it. Nobody should take it for certain.
    """
    if not other.checked_photos():
        return False
    doubted = basis == "pairs" and beside.is_green()
    return doubted or not other.contradicted() or beside.contradicted() > 0


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
