"""From verified pairs to checked models: view graph, mapper and check, in rounds.

Where photos contradict each other in a model, pairs that joined them are refuted, and the model is
made again without them. Pairs that these had outvoted are then trusted. So other ways to join the
groups of photos are tried until the photos agree with one, or until no pair is left that joins the
groups.
"""

import dataclasses
import logging
import shutil
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.database import drop_pairs
from jaxsfm.colmap.mapper import Attempt, MapOptions, build_models, registered
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.two_views import TwoView
from jaxsfm.config import Config, Refinement
from jaxsfm.io.images import ImageError
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Photos
from jaxsfm.sfm.check.check_model import Checked, VerifiedMatches, check_model
from jaxsfm.sfm.check.model_check import Contradiction, ModelCheck
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.view_graph import Verdict, trusted_pairs

if TYPE_CHECKING:
    import pycolmap

MAX_ROUNDS = 4
"""At most so many times the pairs are mapped. A model without contradictions takes one round, the
courtyard of castle-P19 at 800 px and a rendered room take two. Each takes as long as the first."""

logger = logging.getLogger("jaxsfm")


class VerifiedPairs(NamedTuple):
    """What the mapper starts from."""

    database: Path
    """With all verified pairs."""
    two_views: Mapping[Pair, TwoView]
    """Their geometries."""
    matches: Mapping[Pair, PairResult]
    """Their matches, original pixels."""
    photos: Photos


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


class _Round(NamedTuple):
    """The models of one round, and what their checks say."""

    models: "list[pycolmap.Reconstruction]"
    verdicts: dict[Pair, Verdict]
    checks: list[Checked | None]

    def against(self) -> dict[Pair, Contradiction]:
        """The pairs that the next round must do without as well.

        Pairs that are suspected because of their groups are left out only if no pair is refuted by
        its own two photos: with these gone, the groups may be joined rightly.
        """
        done = [each for each in self.checks if each is not None]
        refuted = {pair: why for each in done for pair, why in each.refuted.items()}
        return refuted or {pair: why for each in done for pair, why in each.suspected.items()}

    def contradicted(self) -> bool:
        """Whether photos contradict each other in one of the models."""
        return any(each is not None and each.check.contradictions for each in self.checks)

    def num_checked(self) -> int:
        """The number of photos in models that were checked."""
        groups = [each.check.groups for each in self.checks if each is not None]
        return sum(len(group) for each in groups for group in each)

    def explained(self) -> set[Pair]:
        """Pairs that agree with the models."""
        return {pair for each in self.checks if each is not None for pair in each.explained}


def build_checked_models(
    given: VerifiedPairs,
    database: Path,
    *,
    config: Config,
    options: MapOptions,
    on_image: Callable[[], None] = lambda: None,
) -> "tuple[list[pycolmap.Reconstruction], MappingFigures]":
    """Map verified pairs until no photo contradicts the others, in at most `MAX_ROUNDS` rounds.

    Pairs that were left out are taken back in one more round, if they agree with models in which no
    photo contradicts another. If photos still contradict each other after the last round, its
    models are returned all the same, and their checks say so. A round that leaves no model to check
    does not count.

    Args:
      database: where to write the pairs that the models were made from.
      config: its `view_graph` and `checked` switch these parts on.
      on_image: called for every image that the mapper registers.
    """
    attempts: list[Attempt] = []

    def map_without(refuted: Mapping[Pair, Contradiction]) -> _Round:
        verdicts = _verdicts(given.two_views, refuted, view_graph=config.view_graph)
        trusted = _write_trusted(given, verdicts, database)
        models, starts = build_models(database, trusted, options, on_image=on_image)
        attempts.extend(starts)
        return _Round(models, verdicts, _check(models, given, refuted, config, options.seed))

    refuted: dict[Pair, Contradiction] = {}
    made = map_without(refuted)
    for _ in range(MAX_ROUNDS - 1):
        against = made.against()
        if not against:
            break
        logger.info("photos contradict each other; mapping without %d pairs", len(against))
        refuted |= against
        tried = map_without(refuted)
        if not tried.num_checked():  # these pairs were all that held photos together
            _write_trusted(given, made.verdicts, database)
            break
        made = tried
    if (back := refuted.keys() & made.explained()) and not made.contradicted():
        again = map_without({pair: why for pair, why in refuted.items() if pair not in back})
        if not again.contradicted() and again.num_checked() >= made.num_checked():
            made = again
        else:
            _write_trusted(given, made.verdicts, database)
    checks = [each and each.check for each in made.checks]
    return made.models, MappingFigures(verdicts=made.verdicts, attempts=attempts, checks=checks)


def _write_trusted(
    given: VerifiedPairs, verdicts: Mapping[Pair, Verdict], database: Path
) -> dict[Pair, TwoView]:
    """Write a database without the pairs that are not trusted; returns the trusted ones."""
    dropped = {pair for pair, verdict in verdicts.items() if not verdict.trusted}
    shutil.copyfile(given.database, database)
    drop_pairs(database, sorted(dropped))
    return {pair: view for pair, view in given.two_views.items() if pair not in dropped}


def _verdicts(
    two_views: Mapping[Pair, TwoView], refuted: Mapping[Pair, Contradiction], *, view_graph: bool
) -> dict[Pair, Verdict]:
    """The verdicts on pairs; without the view graph, only those that are refuted have one."""
    geometries = {pair: v.geometry for pair, v in two_views.items() if pair not in refuted}
    verdicts = trusted_pairs(geometries, strict=bool(refuted)) if view_graph else {}
    return verdicts | {pair: _refuted(each) for pair, each in refuted.items()}


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


def _check(
    models: "list[pycolmap.Reconstruction]",
    given: VerifiedPairs,
    refuted: Collection[Pair],
    config: Config,
    seed: int,
) -> list[Checked | None]:
    """The checks of models; None where one was not checked."""
    if not config.checked:
        return [None] * len(models)
    checks: list[Checked | None] = []
    matches = VerifiedMatches(given.matches, given.two_views.keys(), refuted, seed)
    for each in models:
        sizes = {name: given.photos.working_size(name) for name in registered(each)}
        images = DeviceImages(given.photos.gray)
        try:
            model = Model.from_colmap(each, sizes)
            checks.append(check_model(model, images, matches, config.refinement or Refinement()))
        except ImageError as error:  # a photo was deleted since; the model remains
            logger.warning("a model was not checked: %s", error)
            checks.append(None)
    return checks
