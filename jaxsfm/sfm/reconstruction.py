"""From matches to models, in three stages: verification, mapping with the view graph and the check,
and refinement.

Each stage reads the files of the one before. So a stage whose files exist from an earlier run
(`jaxsfm.run_folder`) gives what it would give if it ran again.
"""

import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_folders import read_models, write_models
from jaxsfm.colmap.two_views import read_two_views, verify
from jaxsfm.config import Config, Refinement
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import ChosenMatches, OverlaidMatches, Pair, PairResult
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import digest
from jaxsfm.io.versions import package_versions
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.sfm import stage_files
from jaxsfm.sfm.check.check_model import CHECKED_BY
from jaxsfm.sfm.check.model_check import ModelCheck
from jaxsfm.sfm.checker import VerifiedPairs
from jaxsfm.sfm.mapping import MappingFigures, build_checked_models
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refined_models import Believed, refine_models
from jaxsfm.sfm.stage_files import VerificationFigures

if TYPE_CHECKING:
    import pycolmap

DATABASE, SPARSE, ALTERNATIVE = "database.db", "sparse", "alternative"


class StageCache(NamedTuple):
    """Stages of earlier runs, and what tells whether they still hold."""

    folder: WorkFolder
    matches_key: str
    """Identifies the matches. A stage is used again only for the same matches."""
    suffix: str = ""
    """Of the names of the stages, so that those of several looks lie beside each other."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatchedPhotos:
    """Photos with their matches, and how models are made from them.

    UserError if the known cameras do not fit the photos.
    """

    images: list[ImageFile]
    matches: Mapping[Pair, PairResult]
    """The result of `match`."""
    config: Config
    """Its `view_graph`, `checked` and `refinement` switch those parts on. The refinement works at
    its size."""
    described: Config
    """The settings that the matches were made with."""
    cameras: Cameras
    options: MapOptions
    """Of the mapper; its `scale` is that of the described photos."""

    def __post_init__(self) -> None:
        self.cameras.check_fits(self.images)


class MappedStage(NamedTuple):
    """The models of the mapper, in the folder of their stage."""

    verification: VerificationFigures
    figures: MappingFigures
    folder: Path
    key: str
    """Identifies all that the models depend on."""

    @property
    def database(self) -> Path:
        """COLMAP's database of the models."""
        return self.folder / DATABASE

    def models(self, name: str = SPARSE) -> "list[pycolmap.Reconstruction]":
        """The models, or the `ALTERNATIVE` ones."""
        return read_models(self.folder / name, self.database)


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


def reconstruct(
    images: list[ImageFile],
    matches: Mapping[Pair, PairResult],
    database: Path,
    *,
    config: Config,
    cameras: Cameras | None = None,
    options: MapOptions | None = None,
) -> Reconstructed:
    """Make COLMAP models from verified matches: mapping of trusted pairs, check, refinement.

    Pixel thresholds are multiplied by `Photos.median_scale`. Points get the colours of the photos.

    Args:
      matches: the result of `match`.
      database: where to write the COLMAP database; a file there is replaced.
      config: the one that the matches were made with. Its `view_graph`, `checked` and `refinement`
        switch those parts on.
      cameras: what is known and assumed of the cameras; by default no camera is known.
      options: of the mapper. By default it is incremental, and refines the intrinsics unless the
        cameras are known.

    Raises:
      UserError: the cameras do not fit the images, or COLMAP fails.
    """
    given = matched_photos(
        images,
        matches,
        config=config,
        described=config,
        cameras=cameras or Cameras(),
        options=options,
    )
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        stages = StageCache(WorkFolder(Path(scratch), {}), "")
        return refine_mapped(given, map_matches(given, stages), database, stages)


def matched_photos(
    images: list[ImageFile],
    matches: Mapping[Pair, PairResult],
    *,
    config: Config,
    described: Config,
    cameras: Cameras,
    options: MapOptions | None,
) -> MatchedPhotos:
    """Photos with their matches; `options` as in `reconstruct`, in pixels of the described photos.

    Raises:
      UserError: the cameras do not fit the images.
    """
    options = options or MapOptions(refine_intrinsics=cameras.known is None)
    scale = Photos(images, described).median_scale()
    return MatchedPhotos(
        images=images,
        matches=matches,
        config=config,
        described=described,
        cameras=cameras,
        options=dataclasses.replace(options, scale=scale),
    )


def map_matches(
    given: MatchedPhotos,
    kept: StageCache,
    on_image: Callable[[], None] = lambda: None,
    go_on: Callable[[], bool] | None = None,
) -> MappedStage:
    """Verify the matches, and map the trusted pairs until no photo contradicts the others.

    Args:
      kept: stages of earlier runs, which are used again where they hold. New ones are kept there.
      on_image: called for every image that the mapper registers.
      go_on: as in `build_checked_models`; None: always go on. The answer follows from the photos.

    Raises:
      UserError: COLMAP fails.
    """
    config, options, stages = given.config, given.options, kept.folder

    def verify_matches(folder: Path) -> None:
        write_database(folder / DATABASE, given.images, given.matches, given.cameras)
        figures = _verified(folder / DATABASE, options, config.view_graph)
        stage_files.write_verification(folder, figures)

    def build(folder: Path) -> None:
        two_views = read_two_views(verified / DATABASE)
        photos = Photos(given.images, given.described)
        made = build_checked_models(
            VerifiedPairs(verified / DATABASE, two_views, given.matches, photos),
            folder / DATABASE,
            config=config,
            options=options,
            on_image=on_image,
            go_on=go_on or (lambda: True),
            steps=stages.steps(name, key),
        )
        write_models(made.models, folder / SPARSE)
        write_models(made.alternative, folder / ALTERNATIVE)
        stage_files.write_mapping(folder, made.figures)

    by_image = [[image.name, image.content, image.size] for image in given.images]
    camera = given.cameras.plain()
    verifying = [options.seed, options.threads, options.scale, config.view_graph]
    key = digest(
        kept.matches_key, stage_files.FORMAT, by_image, camera, verifying, package_versions()
    )
    verified = stages.stage("verified" + kept.suffix, key, verify_matches)
    aligning = config.refinement or Refinement()
    checking = config.checked and [getattr(aligning, name) for name in CHECKED_BY]
    refines = config.refinement is not None
    key = digest(key, dataclasses.asdict(options), checking, refines, go_on is not None)
    name = "mapped" + kept.suffix
    verification = stage_files.read_verification(verified)
    mapped = stages.stage(name, key, build)
    return MappedStage(verification, stage_files.read_mapping(mapped), mapped, key)


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
    name: str = "refined",
) -> Reconstructed:
    """Refine the models of the mapper, if asked for, and colour their points.

    Args:
      mapped: made from what is given.
      database: where to write the COLMAP database; a file there is replaced.
      kept: as in `map_matches`.
      closer: matches of closer looks at photos that have no place, original pixels. They say
        where these photos may stand, instead of the matches of the same pairs.
      name: of the stage.
    """
    config, matches = given.config, given.matches
    false = mapped.figures.misleading()
    closer = {pair: found for pair, found in (closer or {}).items() if pair not in false}

    def refine(folder: Path) -> None:
        believed = ChosenMatches(matches, [pair for pair in matches if pair not in false])
        made = refine_models(
            mapped.models(),
            Photos(given.images, config),
            Believed(
                mapped.database,
                OverlaidMatches(believed, closer),
                mapped.verification.verified.keys() - false,
            ),
            config=config,
            options=given.options,
            on_pass=on_pass,
            steps=kept.folder.steps(name, key),
        )
        write_models(made.models, folder / SPARSE)
        stage_files.write_refinement(folder, made.figures, made.order)

    settings = config.refinement and dataclasses.asdict(config.refinement)
    looked = [
        [*pair, closer[pair].keypoints0.tolist(), closer[pair].keypoints1.tolist()]
        for pair in sorted(closer)
    ]
    key = digest(mapped.key, settings, config.max_size, config.enlarge, looked)
    refined = kept.folder.stage(name, key, refine)
    shutil.copyfile(mapped.database, database)
    refinement, order = stage_files.read_refinement(refined)
    models = read_models(refined / SPARSE, database)
    if config.refinement is not None and None in refinement:
        kept.folder.forget_stage(name)  # a photo could not be read; perhaps it can next time
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


def _verified(database: Path, options: MapOptions, view_graph: bool) -> VerificationFigures:
    """Verify the matches of a database."""
    verify(
        database,
        options.verification(relative_poses=view_graph),
    )
    two_views = read_two_views(database)
    return VerificationFigures(
        verified={pair: view.geometry.num_inliers for pair, view in two_views.items()},
        angles={pair: view.tri_angle_deg for pair, view in two_views.items()},
    )
