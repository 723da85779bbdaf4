"""The refinement of all models of a run, as a stage that is kept."""

import dataclasses
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.model_files import read_models, write_models
from jaxsfm.config import Config
from jaxsfm.io.atomic import Json
from jaxsfm.io.pairs import ChosenMatches, Pair, PairResult
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import digest
from jaxsfm.io.typed_files import read_figures, write_figures
from jaxsfm.sfm.check.model_check import ModelCheck
from jaxsfm.sfm.mapped_stage import (
    ALTERNATIVE,
    FIGURES,
    SPARSE,
    MatchedPhotos,
    StageCache,
    VerificationFigures,
    VerifiedStage,
)
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refined_models import Believed, RefinedModels, refine_models
from jaxsfm.sfm.selected_stage import SelectedModels

if TYPE_CHECKING:
    import pycolmap


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reconstructed:
    """The models of verified matches, and how they came about."""

    verification: VerificationFigures
    mapping: MappingFigures
    models: "list[pycolmap.Reconstruction]"
    """The model with most images first; empty if there is none."""
    alternative: "list[pycolmap.Reconstruction]"
    """Models that join the photos in another way, not refined; empty if there is no other way."""
    refinement: list[RefinementFigures | None]
    """For each model; None where it was not refined."""

    @classmethod
    def nothing(cls, verification: VerificationFigures) -> "Reconstructed":
        """No model of verified matches."""
        mapping = MappingFigures(verdicts={}, attempts=[], checks=[])
        return cls(
            verification=verification, mapping=mapping, models=[], alternative=[], refinement=[]
        )


class RefinedFigures(NamedTuple):
    """What a stage leaves beside refined models."""

    models: list[RefinementFigures | None]
    """For each model; None: it was not refined."""
    order: list[int]
    """For each model, its index among the models that the stage was given."""


def check_refined(check: ModelCheck | None, done: RefinementFigures | None) -> ModelCheck | None:
    """The check of a model, with what its refinement found; None if it was not checked."""
    unconfirmed = done is not None and not done.confirmed
    return check and dataclasses.replace(check, unconfirmed=unconfirmed)


def refine_selected(
    given: MatchedPhotos,
    verified: VerifiedStage,
    selected: SelectedModels,
    database: Path,
    kept: StageCache,
    on_pass: Callable[[], None] = lambda: None,
) -> Reconstructed:
    """Refine the models, if asked for, and colour their points.

    Args:
      database: where to write the COLMAP database; a file there is replaced.
      kept: as in `jaxsfm.sfm.road.walk`.
    """
    config = given.config

    def refine(folder: Path) -> None:
        after = refine_models(
            selected.models(),
            Photos(given.images, config),
            Believed(selected.database, believed_matches(given, selected)),
            config=config,
            options=given.options,
            on_pass=on_pass,
        )
        write_refined(folder, after)

    key = digest(selected.key, *refinement_settings(config))
    refined = kept.folder.stage("refined", key, refine)
    shutil.copyfile(selected.database, database)
    refinement, order = read_figures(refined / FIGURES, RefinedFigures)
    models = read_models(refined / SPARSE, database)
    if config.refinement is not None and None in refinement:
        kept.folder.forget_stage("refined")  # a photo could not be read; perhaps it can next time
    checks = [
        check_refined(selected.figures.checks[k], done)
        for k, done in zip(order, refinement, strict=True)
    ]
    return Reconstructed(
        verification=verified.figures,
        mapping=dataclasses.replace(selected.figures, checks=checks),
        models=models,
        alternative=selected.models(ALTERNATIVE),
        refinement=refinement,
    )


def believed_matches(given: MatchedPhotos, selected: SelectedModels) -> Mapping[Pair, PairResult]:
    """The matches that no check has found to be false, original pixels."""
    false = selected.figures.misleading()
    return ChosenMatches(given.matches, [pair for pair in given.matches if pair not in false])


def write_refined(folder: Path, after: RefinedModels) -> None:
    """Write refined models into the folder of a stage."""
    write_models(after.models, folder / SPARSE)
    write_figures(folder / FIGURES, RefinedFigures(after.figures, after.order))


def refinement_settings(config: Config) -> list[Json]:
    """What the refinement depends on besides its models and matches."""
    settings = config.refinement and dataclasses.asdict(config.refinement)
    return [settings, config.max_size, config.enlarge]
