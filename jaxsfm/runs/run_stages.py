"""The stages of a run after matching, with their progress bars and times."""

import contextlib
import dataclasses
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.external_matches import ExternalMatches, JoinedMatches
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.measured_positions import write_pose_priors
from jaxsfm.colmap.model_files import write_models
from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile, orientations
from jaxsfm.io.pairs import Pair
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import SavedMatches, digest
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.runs.job import MatchedPairs, timed
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.georeference.georeference import Georeference, MeasuredPositions, move_models
from jaxsfm.sfm.georeference.inside import Settings
from jaxsfm.sfm.mapped_stage import (
    ALTERNATIVE,
    DATABASE,
    SPARSE,
    MatchedPhotos,
    StageCache,
    matched_photos,
)
from jaxsfm.sfm.refined_stage import Reconstructed
from jaxsfm.sfm.register.lost import MatchLost
from jaxsfm.sfm.road import Watch, walk


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunModels:
    """The models of a run, and what they were made of."""

    made: Reconstructed
    handed_on: Collection[Pair]
    """The pairs whose matches were written into COLMAP's database."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunStages:
    """What the stages of a run need besides its matches."""

    folder: WorkFolder
    images: list[ImageFile]
    cameras: Cameras
    external: ExternalMatches
    config: Config
    options: RunOptions
    measured: MeasuredPositions | None
    """What the models are moved onto after the refinement; None: they are not moved."""
    seconds: dict[str, float]
    """Wall-clock time of each stage, seconds; the stages add theirs."""

    def walk(self, matched: MatchedPairs, target: Path, match_lost: MatchLost) -> RunModels:
        """Make models of the pairs with inliers (`jaxsfm.sfm.road`).

        Args:
          target: folder for the database.
          match_lost: as in `jaxsfm.sfm.road.walk`.
        """
        given = self._given(matched)
        key = digest(
            [[*pair, matched.store.match_key(pair)] for pair in self._chosen(matched)],
            self.external.about and self.external.about["sha256"],
        )
        with self._watch() as watch:
            made = walk(
                given,
                StageCache(self.folder, key),
                target / DATABASE,
                without=self.options.without,
                match_lost=match_lost,
                watch=watch,
            )
        return RunModels(made=made, handed_on=given.matches.keys())

    def _chosen(self, matched: MatchedPairs) -> list[Pair]:
        return matched.with_inliers(self.options.best_pairs)

    def _given(self, matched: MatchedPairs) -> MatchedPhotos:
        ours, options = SavedMatches(matched.store, self._chosen(matched)), self.options
        return matched_photos(
            self.images,
            JoinedMatches(ours, self.external, {image.name for image in self.images}),
            config=self.config,
            described=matched.described,
            cameras=self.cameras,
            options=MapOptions(
                mapper=options.mapper,
                refine_intrinsics=options.refines,
                seed=options.seed,
                threads=options.threads,
            ),
        )

    @contextlib.contextmanager
    def _watch(self) -> Iterator[Watch]:
        """Progress bars of the mapping and of the refinement, and the time of each stage."""
        photos, quiet = len(self.images), not self.options.progress
        refines = self.config.refinement is not None
        with (
            tqdm(total=photos, desc="mapping", unit="image", disable=quiet) as mapped,
            tqdm(desc="refinement", unit="pass", disable=quiet or not refines) as passes,
        ):

            def stage(name: str) -> AbstractContextManager[None]:
                # Without a refinement, its stage only copies the models.
                return timed(self.seconds if refines or name != "refinement" else {}, name)

            def on_image() -> None:
                mapped.update(mapped.n < photos)  # several models may share images

            def on_pass() -> None:
                passes.update()

            yield Watch(stage, on_image, on_pass)

    def write(self, made: Reconstructed, target: Path) -> Georeference | None:
        """Move the models onto the measured positions, and write them into `target`."""
        moved = self._move(made, target / DATABASE)
        write_models(made.models, target / SPARSE)
        write_models(made.alternative, target / ALTERNATIVE)
        return moved

    def _move(self, made: Reconstructed, database: Path) -> Georeference | None:
        """Move the models onto the measured positions, which become COLMAP's pose priors.

        This is the last step: the stages before it keep their models in the frame of the mapper, so
        they hold for other positions too.
        """
        measured = self.measured
        if measured is None:
            return None
        geographic = measured.system.kind == "geographic"
        priors = measured.positions if geographic else measured.local(measured.frame())
        write_pose_priors(database, priors, geographic=geographic)
        if not made.models:
            return None
        settings = None
        if self.options.positions_inside:
            scale = Photos(self.images, self.config).median_scale()
            settings = Settings(loss_px=scale, refine_intrinsics=self.options.refines)
        return move_models(made.models, measured, orientations(self.images), settings)
