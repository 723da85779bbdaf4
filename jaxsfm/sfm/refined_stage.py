"""From the models of the mapper to refined ones, which are kept as those of the mapper are."""

import dataclasses
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsfm.colmap.model_folders import read_models, write_models
from jaxsfm.colmap.model_images import fingerprint, registered_in_any
from jaxsfm.config import Config
from jaxsfm.io.atomic import Json
from jaxsfm.io.pairs import ChosenMatches, OverlaidMatches, Pair, PairResult
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import digest
from jaxsfm.sfm import stage_files
from jaxsfm.sfm.check.model_check import ModelCheck
from jaxsfm.sfm.mapped_stage import (
    ALTERNATIVE,
    SPARSE,
    MappedStage,
    MatchedPhotos,
    StageCache,
)
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refined_models import Believed, RefinedModels, place_photos, refine_models
from jaxsfm.sfm.stage_files import VerificationFigures

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


def check_refined(check: ModelCheck | None, done: RefinementFigures | None) -> ModelCheck | None:
    """The check of a model, with what its refinement found; None if it was not checked."""
    unconfirmed = done is not None and not done.confirmed
    return check and dataclasses.replace(check, unconfirmed=unconfirmed)


def refine_mapped(
    given: MatchedPhotos,
    mapped: MappedStage,
    database: Path,
    kept: StageCache,
    on_pass: Callable[[], None] = lambda: None,
    closer: Mapping[Pair, PairResult] | None = None,
) -> Reconstructed:
    """Refine the models of the mapper, if asked for, and colour their points.

    Args:
      mapped: made from what is given.
      database: where to write the COLMAP database; a file there is replaced.
      kept: as in `map_matches`.
      closer: matches of closer looks at photos that are in no model, original pixels. They say
        where these photos may stand, instead of the matches of the same pairs.
    """
    config = given.config
    closer = _not_false(closer or {}, mapped)

    def refine(folder: Path) -> None:
        after = refine_models(
            mapped.models(),
            Photos(given.images, config),
            _believed(given, mapped, closer),
            config=config,
            options=given.options,
            on_pass=on_pass,
            steps=kept.folder.steps("refined", key),
        )
        _write(folder, after)

    key = digest(mapped.key, *_settings(config), _looked(closer))
    refined = kept.folder.stage("refined", key, refine)
    shutil.copyfile(mapped.database, database)
    refinement, order = stage_files.read_refinement(refined)
    models = read_models(refined / SPARSE, database)
    if config.refinement is not None and None in refinement:
        kept.folder.forget_stage("refined")  # a photo could not be read; perhaps it can next time
    checks = [
        check_refined(mapped.figures.checks[k], done)
        for k, done in zip(order, refinement, strict=True)
    ]
    return Reconstructed(
        verification=mapped.verification,
        mapping=dataclasses.replace(mapped.figures, checks=checks),
        models=models,
        alternative=mapped.models(ALTERNATIVE),
        refinement=refinement,
    )


def place_lost(
    given: MatchedPhotos,
    mapped: MappedStage,
    made: Reconstructed,
    kept: StageCache,
    closer: Mapping[Pair, PairResult],
) -> Reconstructed:
    """Place photos that the refinement has taken out, by matches of closer looks.

    They are placed as photos that the mapper had left out, so their places have to stand the same
    tests. The models are not refined again.

    Args:
      mapped, given, kept: those of the refinement.
      made: its outcome.
      closer: matches of closer looks at these photos, original pixels.
    """
    closer = _not_false(closer, mapped)
    lost = {name for pair in closer for name in pair} - registered_in_any(made.models)

    def place(folder: Path) -> None:
        after = place_photos(
            made.models,
            made.refinement,
            Photos(given.images, given.config),
            _believed(given, mapped, closer),
            lost=lost,
            config=given.config,
            options=given.options,
        )
        _write(folder, after)

    models = [fingerprint(model) for model in made.models]
    key = digest(mapped.key, *_settings(given.config), models, _looked(closer))
    stage = kept.folder.stage("placed", key, place)
    refinement, order = stage_files.read_refinement(stage)
    checks = [made.mapping.checks[k] for k in order]
    return dataclasses.replace(
        made,
        mapping=dataclasses.replace(made.mapping, checks=checks),
        models=read_models(stage / SPARSE, mapped.database),
        refinement=refinement,
    )


def _not_false(closer: Mapping[Pair, PairResult], mapped: MappedStage) -> dict[Pair, PairResult]:
    """Matches of closer looks without those of pairs that the rounds found to be false."""
    false = mapped.figures.misleading()
    return {pair: found for pair, found in closer.items() if pair not in false}


def _believed(
    given: MatchedPhotos, mapped: MappedStage, closer: Mapping[Pair, PairResult]
) -> Believed:
    false = mapped.figures.misleading()
    believed = ChosenMatches(given.matches, [pair for pair in given.matches if pair not in false])
    return Believed(
        mapped.database,
        OverlaidMatches(believed, closer),
        mapped.verification.verified.keys() - false,
    )


def _write(folder: Path, after: RefinedModels) -> None:
    write_models(after.models, folder / SPARSE)
    stage_files.write_refinement(folder, after.figures, after.order)


def _settings(config: Config) -> list[Json]:
    """What the refinement depends on besides its models and matches."""
    settings = config.refinement and dataclasses.asdict(config.refinement)
    return [settings, config.max_size, config.enlarge]


def _looked(closer: Mapping[Pair, PairResult]) -> list[Json]:
    """The matches of closer looks, as a stage's key has them."""
    return [
        [*pair, closer[pair].keypoints0.tolist(), closer[pair].keypoints1.tolist()]
        for pair in sorted(closer)
    ]
