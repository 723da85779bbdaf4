"""From matches to the models of the mapper: verification, and mapping with its check.

Each of the two stages reads the files of the one before. So a stage whose files exist from an
earlier run (`jaxsfm.run_folder`) gives what it would give if it ran again.
"""

import dataclasses
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
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import digest
from jaxsfm.io.versions import package_versions
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.sfm import stage_files
from jaxsfm.sfm.check.check_model import CHECKED_BY
from jaxsfm.sfm.checker import VerifiedPairs
from jaxsfm.sfm.mapping import MappingFigures, build_checked_models
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
