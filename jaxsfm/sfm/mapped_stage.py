"""What the road starts from, and its first stages: verified pairs, and mappings with their checks.

Each stage reads the files of the one before. So a stage whose files exist from an earlier run
(`jaxsfm.io.work_folder`) gives what it would give if it ran again.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import drop_pairs, write_database
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import LOW_ANGLE_DEG
from jaxsfm.colmap.model_files import read_models, write_models
from jaxsfm.colmap.rigs import pairs_against_rigs
from jaxsfm.colmap.two_views import read_two_views, verify
from jaxsfm.config import Config, Refinement
from jaxsfm.io.atomic import Json
from jaxsfm.io.images import ImageFile
from jaxsfm.io.libraries import package_versions
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import digest
from jaxsfm.io.typed_files import read_figures, write_figures
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.sfm.check.check_model import CHECKED_BY, MIN_CHECKED_POINTS, Checked
from jaxsfm.sfm.check.model_check import MIN_VIEWS, ModelCheck
from jaxsfm.sfm.checker import VerifiedPairs
from jaxsfm.sfm.limits import TRUST
from jaxsfm.sfm.mapping import MappedModels, Mapper, Trust
from jaxsfm.sfm.one_place import from_one_place

if TYPE_CHECKING:
    import pycolmap

DATABASE, SPARSE, ALTERNATIVE = "database.db", "sparse", "alternative"
FIGURES = "figures.msgpack"
"""What a stage leaves beside its models."""
FORMAT = 24
"""The version of what the stages leave. It is part of their keys, so that stages of another version
are not used."""


class StageCache(NamedTuple):
    """Stages of earlier runs, and what tells whether they still hold."""

    folder: WorkFolder
    matches_key: str
    """Identifies the matches. A stage is used again only for the same matches."""


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

    def unrefined(self) -> "MatchedPhotos":
        """The same photos, whose models are not refined."""
        return dataclasses.replace(self, config=dataclasses.replace(self.config, refinement=None))


@dataclasses.dataclass(frozen=True, kw_only=True)
class VerificationFigures:
    """The results of verification."""

    verified: dict[Pair, int]
    """Number of two-view inliers, by pair that has any."""
    angles: dict[Pair, float]
    """Degrees at which the rays of a verified pair's points meet (median); 0: unknown."""
    one_place: bool = False
    """Whether all photos were taken from one place."""

    @property
    def no_depth(self) -> bool:
        """Whether nothing gives depth: photos from one place, or something that stays as it is in
        all of them. The mapper has no pair to start from then, at whatever size photos are
        matched."""
        known = [angle for angle in self.angles.values() if angle > 0]
        return self.one_place or (bool(known) and max(known) < LOW_ANGLE_DEG)


class VerifiedStage(NamedTuple):
    """The verified pairs, in the folder of their stage."""

    figures: VerificationFigures
    pairs: VerifiedPairs
    key: str
    """Identifies all that they depend on."""


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
        options=dataclasses.replace(options, scale=scale, held=cameras.held(images)),
    )


def verify_matches(given: MatchedPhotos, kept: StageCache) -> VerifiedStage:
    """Let COLMAP verify the matches.

    Args:
      kept: stages of earlier runs, which are used again where they hold. New ones are kept there.

    Raises:
      UserError: COLMAP fails.
    """
    config, options = given.config, given.options
    photos = Photos(given.images, given.described)

    def compute(folder: Path) -> None:
        write_database(folder / DATABASE, given.images, given.matches, given.cameras)
        verify(folder / DATABASE, options.verification(relative_poses=config.view_graph))
        views = read_two_views(folder / DATABASE)
        contrary = pairs_against_rigs(folder / DATABASE, views, TRUST.rotation_deg)
        if contrary:
            drop_pairs(folder / DATABASE, contrary)
            views = {pair: view for pair, view in views.items() if pair not in contrary}
        figures = VerificationFigures(
            verified={pair: view.geometry.num_inliers for pair, view in views.items()},
            angles={pair: view.tri_angle_deg for pair, view in views.items()},
            one_place=config.checked and from_one_place(folder / DATABASE, photos),
        )
        write_figures(folder / FIGURES, figures)

    by_image = [[image.name, image.content, image.size] for image in given.images]
    camera = given.cameras.plain()
    settings = [options.seed, options.threads, options.scale, config.view_graph, config.checked]
    key = digest(kept.matches_key, FORMAT, by_image, camera, settings, package_versions())
    folder = kept.folder.stage("verified", key, compute)
    views = read_two_views(folder / DATABASE)
    pairs = VerifiedPairs(folder / DATABASE, views, given.matches, photos)
    return VerifiedStage(read_figures(folder / FIGURES, VerificationFigures), pairs, key)


def map_trusted(
    given: MatchedPhotos,
    verified: VerifiedStage,
    trust: Trust,
    name: str,
    kept: StageCache,
    on_image: Callable[[], None] = lambda: None,
) -> MappedModels:
    """Map the trusted pairs, and check the models.

    Args:
      name: of the stage.
      on_image: called for every image that the mapper registers.

    Raises:
      UserError: COLMAP fails.
    """
    mapper = mapper_of(given, verified)

    def compute(folder: Path) -> None:
        made = mapper.map(trust, folder / DATABASE, on_image)
        write_models(made.models, folder / SPARSE)
        write_figures(folder / FIGURES, made.checks)

    key = digest(verified.key, *mapping_settings(given), _plain(trust))
    folder = kept.folder.stage(name, key, compute)
    models = read_models(folder / SPARSE, folder / DATABASE)
    checks = read_figures(folder / FIGURES, list[Checked | None])
    if given.config.checked and unchecked(models, checks):
        kept.folder.forget_stage(name)  # a photo could not be read; perhaps it can next time
    return MappedModels(trust=trust, database=folder / DATABASE, models=models, checks=checks)


def unchecked(
    models: "Sequence[pycolmap.Reconstruction]", checks: Sequence[Checked | ModelCheck | None]
) -> bool:
    """Whether a model is without a check that has photos and points enough for one."""
    return any(
        check is None
        and model.num_reg_images() >= MIN_VIEWS
        and model.num_points3D() >= MIN_CHECKED_POINTS
        for model, check in zip(models, checks, strict=True)
    )


def mapper_of(given: MatchedPhotos, verified: VerifiedStage) -> Mapper:
    """The mapper of verified photos."""
    return Mapper(verified.pairs, config=given.config, options=given.options)


def mapping_settings(given: MatchedPhotos) -> list[Json]:
    """What a mapping depends on besides its pairs."""
    config = given.config
    aligning = config.refinement or Refinement()
    checking = config.checked and [getattr(aligning, name) for name in CHECKED_BY]
    return [dataclasses.asdict(given.options), checking, config.refinement is not None]


def _plain(trust: Trust) -> list[Json]:
    return [trust.basis, trust.thorough, sorted(trust.dropped())]
