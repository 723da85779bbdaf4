"""The stages of a run after matching, with their progress bars and times."""

import dataclasses
import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.external_matches import ExternalMatches, JoinedMatches
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_folders import write_models
from jaxsfm.colmap.model_images import registered
from jaxsfm.colmap.pose_priors import write_pose_priors
from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile
from jaxsfm.io.looks import SavedMatches
from jaxsfm.io.pairs import Pair, PairCounts, PairResult
from jaxsfm.io.store import digest
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.runs.matching_looks import MatchedPairs, timed
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.check.model_check import MIN_VIEWS
from jaxsfm.sfm.georeference.georeference import Georeference, MeasuredPositions, move_models
from jaxsfm.sfm.mapped_stage import (
    ALTERNATIVE,
    DATABASE,
    SPARSE,
    MappedStage,
    MatchedPhotos,
    StageCache,
    map_matches,
    matched_photos,
)
from jaxsfm.sfm.mapping import green
from jaxsfm.sfm.refined_stage import Reconstructed, place_lost, refine_mapped
from jaxsfm.sfm.round import nearly_equal
from jaxsfm.sfm.second_look import SecondLook, second_look


@dataclasses.dataclass(frozen=True)
class MappedRun:
    """The photos of a run, and the models that the mapper made of them."""

    given: MatchedPhotos
    stage: MappedStage
    cache: StageCache

    @property
    def handed_on(self) -> Collection[Pair]:
        """The pairs whose matches were written into COLMAP's database."""
        return self.given.matches.keys()

    def unsettled(
        self,
        counts: Mapping[Pair, PairCounts],
        models: Sequence[Collection[str]] | None = None,
        *,
        places: bool = False,
    ) -> SecondLook | None:
        """What to look at again; None if nothing.

        Args:
          counts: of all pairs that were tried.
          models: as in `settled_photos`.
          places: whether these models show several places.
        """
        names, settled = [image.name for image in self.given.images], self.settled_photos(models)
        return second_look(counts, names, settled, self.trusted(), places=places)

    def settled_photos(self, models: Sequence[Collection[str]] | None = None) -> set[str]:
        """The photos that have a sure place (`jaxsfm.sfm.second_look`).

        Args:
          models: the photos of each model that counts, because it shows a place of its own, or
            because nothing would join it to another one. None: the best model alone.
        """
        if not self.photos or self.doubted():
            return set()
        checks = [check for check in self.stage.figures.checks if check is not None]
        settled = set().union(*(self.photos[:1] if models is None else models))
        return settled.difference(*(pair for c in checks for pair in c.apart))

    def checked_models(self) -> list[set[str]]:
        """The photos of each model that is large enough to be checked, the largest first."""
        checks = self.stage.figures.checks
        return [own for own, check in zip(self.photos, checks, strict=False) if check is not None]

    def settled(self) -> bool:
        """Whether all photos are in one model, and nothing speaks against it."""
        return self.green() and self.largest() == len(self.given.images)

    def better_than(self, other: "MappedRun") -> bool:
        """Whether there are more photos in the best model, or in the next one if those are equal.

        Models that something speaks against are worse than others, and so are models that are too
        small to be checked, and none. If something speaks against both, and they have nearly as
        many photos in the best model and in all, models that only neighbours speak against are
        better.
        """

        def checked(run: MappedRun) -> bool:
            return run.largest() >= MIN_VIEWS

        def green(run: MappedRun) -> bool:
            return checked(run) and run.green()

        def likely(run: MappedRun) -> bool:
            return checked(run) and not run.doubted()

        def sizes(run: MappedRun) -> list[int]:
            return sorted(map(len, run.photos), reverse=True)

        if green(self) != green(other):
            return green(self)
        ours, theirs = (len(set().union(*run.photos)) for run in (self, other))
        alike = nearly_equal(self.largest(), other.largest()) and nearly_equal(ours, theirs)
        if alike and likely(self) != likely(other):
            return likely(self)
        return sizes(self) > sizes(other)

    def largest(self) -> int:
        """The number of photos in the best model."""
        return max(map(len, self.photos), default=0)

    def doubted(self) -> bool:
        """Whether more speaks against a model than photos that follow each other."""
        return any(check is not None and check.doubted() for check in self.stage.figures.checks)

    @functools.cached_property
    def photos(self) -> list[set[str]]:
        """The photos of each model, the model with most photos first."""
        return [set(registered(model)) for model in self.stage.models()]

    def trusted(self) -> set[Pair]:
        """The verified pairs that the models were made from."""
        verdicts = self.stage.figures.verdicts
        verified = self.stage.verification.verified
        return {p for p in verified if p not in verdicts or verdicts[p].trusted}

    def green(self) -> bool:
        """Whether nothing speaks against the models."""
        return green(self.stage.figures.checks)


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
    look: str = ""
    """The end of the names of the stages' folders, so that several looks lie beside each other."""

    def map(self, matched: MatchedPairs, go_on: Callable[[], bool] | None = None) -> MappedRun:
        """Map the pairs with inliers.

        Args:
          go_on: as in `map_matches`.
        """
        chosen = matched.with_inliers(self.options.best_pairs)
        ours = SavedMatches(matched.looks, chosen)
        matches = JoinedMatches(ours, self.external, {image.name for image in self.images})
        key = digest(
            [[*pair, *matched.looks.match_key(pair)] for pair in chosen],
            self.external.about and self.external.about["sha256"],
        )
        options = self.options
        given = matched_photos(
            self.images,
            matches,
            config=self.config,
            described=matched.described,
            cameras=self.cameras,
            options=MapOptions(
                mapper="global" if options.mapper == "global" else "incremental",
                in_parts=options.mapper == "parts",
                refine_intrinsics=options.refines,
                seed=options.seed,
                threads=options.threads,
            ),
        )
        cache = StageCache(self.folder, key, self.look)
        total, quiet = len(self.images), not options.progress
        with (
            timed(self.seconds, "mapping"),
            tqdm(total=total, desc="mapping", unit="image", disable=quiet) as bar,
        ):

            def on_image() -> None:
                bar.update(bar.n < total)  # several models may share images

            mapped = MappedRun(given, map_matches(given, cache, on_image, go_on), cache)
            # The global mapper does not report images before it ends.
            bar.update(mapped.largest() - bar.n)
        return mapped

    def refine(
        self, mapped: MappedRun, target: Path, closer: Mapping[Pair, PairResult]
    ) -> Reconstructed:
        """Refine the models, and write the database into `target`.

        Args:
          closer: matches of closer looks at photos that are in no model.
        """
        passes = self.config.refinement.passes if self.config.refinement else 0
        quiet = not (self.options.progress and passes)
        with (
            timed(self.seconds if passes else {}, "refinement"),
            tqdm(total=passes, desc="refinement", unit="pass", disable=quiet) as turns,
        ):

            def on_pass() -> None:
                # Another model, and a closer size after a first look, make more passes.
                turns.total = max(turns.total, turns.n + 1)
                turns.update()

            database = target / DATABASE
            return refine_mapped(
                mapped.given, mapped.stage, database, mapped.cache, on_pass, closer
            )

    def place(
        self, mapped: MappedRun, made: Reconstructed, closer: Mapping[Pair, PairResult]
    ) -> Reconstructed:
        """Place photos that the refinement has taken out.

        Args:
          made: the refined models.
          closer: matches of closer looks at these photos.
        """
        with timed(self.seconds, "refinement"):
            return place_lost(mapped.given, mapped.stage, made, mapped.cache, closer)

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
        return move_models(made.models, measured) if made.models else None
