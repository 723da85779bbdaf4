"""The report of a run, written by `reconstruct` and continued by `extend`."""

import dataclasses
import json
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from jaxsfm.colmap.external_matches import ExternalMatches
from jaxsfm.colmap.poses import Poses, model_poses
from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile
from jaxsfm.io.libraries import versions
from jaxsfm.io.orientation import UPRIGHT, quarters_between
from jaxsfm.io.pairs import Pair, PairCounts
from jaxsfm.io.store import SavedMatches
from jaxsfm.report.finished_run import FinishedRun, evaluation_report
from jaxsfm.report.lost_photos import explained, without_depth
from jaxsfm.report.run_inputs import (
    FoundPhotos,
    LowResolution,
    RecordedOptions,
    RunIdentity,
    SamePixels,
    UsedExternalMatches,
    UsedWeights,
)
from jaxsfm.report.run_report import FORMAT, Extension, RunReport
from jaxsfm.report.run_results import ModelRow, PairRow, PairStatus, PlacedPanoramas, TriedPairs
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.runs.working_model import CameraPrior
from jaxsfm.sfm.evaluation import of_photos
from jaxsfm.sfm.georeference.georeference import Georeference
from jaxsfm.sfm.refined_stage import Reconstructed
from jaxsfm.sfm.register.grow import ExtendedModels
from jaxsfm.sfm.view_graph import Verdict

if TYPE_CHECKING:
    import pycolmap


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageResults:
    """The results of a run's stages."""

    folder: Path
    """The folder of the photos."""
    identity: RunIdentity
    usable: list[ImageFile]
    skipped: dict[str, str]
    """Why a photo could not be used, by name."""
    results: Mapping[Pair, PairCounts]
    """The counts of every pair that was tried."""
    handed_on: Collection[Pair]
    """The pairs whose matches were written into COLMAP's database."""
    external: ExternalMatches
    """The matches of another tool, mapped together with ours."""
    reconstructed: Reconstructed
    georeference: Georeference | None
    """How the models were moved into metres."""
    weights: UsedWeights
    low_resolution: LowResolution | None
    same_pixels: SamePixels | None
    panoramas: PlacedPanoramas | None
    seconds: dict[str, float]
    """Wall-clock time of each stage, seconds."""


class NewPhotos(NamedTuple):
    """The photos that were added to the folder of a run since."""

    images: dict[str, ImageFile]
    cameras: dict[str, list[CameraPrior]]
    """The cameras that `images` start with, in each model of the run."""
    skipped: dict[str, str]
    """Why a new file cannot be used, by name."""


def run_report(stages: StageResults, *, config: Config, options: RunOptions) -> RunReport:
    """The report of a new run, without the evaluation."""
    made, results = stages.reconstructed, stages.results
    verified, verdicts = made.verification.verified, made.mapping.verdicts
    about, counts = stages.external.about, stages.external.counts(results)
    untrusted = sum(not verdict.trusted for verdict in verdicts.values())
    report = RunReport(
        format=FORMAT,
        version=stages.identity.version,
        versions=versions(),
        finished=_now(),
        identity=stages.identity,
        weights=stages.weights,
        options=_recorded_options(config, options),
        images=FoundPhotos(
            folder=str(stages.folder.absolute()),
            found=len(stages.usable) + len(stages.skipped),
            usable=len(stages.usable),
            skipped=stages.skipped,
        ),
        pairs=TriedPairs(
            tried=len(results),
            verified=sum(r.num_inliers > 0 for r in results.values()),
            handed_on=len(stages.handed_on),
            trusted=len(verified) - untrusted if verdicts else None,
            overflowed=sum(r.num_dropped > 0 for r in results.values()),
            each=_pair_rows(counts, stages.handed_on, verified, verdicts),
        ),
        given=None if about is None else msgspec.convert(about, UsedExternalMatches),
        low_resolution=stages.low_resolution,
        turned=_turned(stages.usable, stages.identity.orientations),
        same_pixels=stages.same_pixels,
        models=[_model_row(model) for model in made.models],
        panoramas=stages.panoramas,
        mapping=made.mapping.attempts,
        refinement=made.refinement,
        checks=made.mapping.checks,
        georeference=stages.georeference,
        lost=[],
        seconds=stages.seconds,
    )
    sizes = {image.name: image.size for image in stages.usable}
    report = explained(report, config, sizes, made.verification.angles)
    if made.models or not made.verification.no_depth:
        return report
    return without_depth(report, one_place=made.verification.one_place)


def _turned(images: Sequence[ImageFile], orientations: Mapping[str, int]) -> dict[str, int]:
    """The degrees by which photos were turned, beyond what EXIF says."""
    found = {
        image.name: 90 * quarters_between(image.orientation, orientations.get(image.name, UPRIGHT))
        for image in images
    }
    return {name: degrees for name, degrees in found.items() if degrees}


def extended_report(
    run: FinishedRun,
    models: "list[pycolmap.Reconstruction]",
    grown: ExtendedModels,
    new: NewPhotos,
    matches: SavedMatches,
    verified: Mapping[Pair, int],
    sizes: Mapping[str, tuple[int, int]],
) -> RunReport:
    """The report of a run that was extended by new photos.

    Args:
      run: the run before.
      models: the models now.
      matches: the matches of the pairs that were tried for the new photos.
      verified: the number of inliers that COLMAP found in these pairs.
      sizes: (width, height) of every usable photo that is still there, old and new.
    """
    old, pairs, before = run.report, run.report.pairs, run.report.images.skipped
    counts = {pair: result.counts for pair, result in matches.items()}
    good = {pair for pair, each in counts.items() if each.num_inliers}
    extension = Extension(
        finished=_now(),
        added=sorted(new.images),
        registered=sorted(grown.registered),
        skipped=sorted(new.skipped),
        rounds=grown.rounds,
        pairs=len(counts),
    )
    report = dataclasses.replace(
        old,
        format=FORMAT,
        finished=extension.finished,
        images=FoundPhotos(
            folder=run.photos.folder and str(run.photos.folder.absolute()),
            found=old.images.found + len((new.images.keys() | new.skipped.keys()) - before.keys()),
            usable=old.images.usable + len(new.images),
            skipped={n: w for n, w in before.items() if n not in new.images} | new.skipped,
        ),
        pairs=TriedPairs(
            tried=pairs.tried + len(counts),
            verified=pairs.verified + len(good),
            handed_on=pairs.handed_on + len(good),
            overflowed=pairs.overflowed + sum(c.num_dropped > 0 for c in counts.values()),
            # The view graph does not judge the new pairs.
            trusted=None if pairs.trusted is None else pairs.trusted + len(verified),
            each=sorted(
                [*pairs.each, *_pair_rows(counts, good, verified, {})], key=lambda row: row.pair
            ),
        ),
        models=[_model_row(model) for model in models],
        # A model with new photos has points now that no check has seen. The checks of the others
        # are left out, too: alone, they would look like the verdict on all models.
        checks=[],
        extended=[*(old.extended or ()), extension],
        evaluation=None,
        evaluation_failed=None,
    )
    report = explained(report, run.config, sizes, {})
    reasons = {name: found.why for name, found in grown.located.items()}
    lost = [
        dataclasses.replace(photo, detail=reasons.get(photo.image) or photo.detail)
        for photo in report.lost
    ]
    report = dataclasses.replace(report, lost=lost)
    if run.reference is not None:
        return evaluated(report, model_poses(models[0]), run.reference.poses)
    if old.known_options.reference is not None:
        failed = "the run's reference poses cannot be used any more"
        return dataclasses.replace(report, evaluation_failed=failed)
    return report


def evaluated(report: RunReport, poses: Poses, reference: Poses) -> RunReport:
    """The report with the errors against reference poses, or why they cannot be compared."""
    try:
        known = of_photos(reference, report.photos())
        return dataclasses.replace(report, evaluation=evaluation_report(poses, known))
    except UserError as error:
        return dataclasses.replace(report, evaluation_failed=str(error))


def _model_row(model: "pycolmap.Reconstruction") -> ModelRow:
    """The numbers of one COLMAP model."""
    return ModelRow(
        registered=model.num_reg_images(),
        points=model.num_points3D(),
        observations=model.compute_num_observations(),
        track_length=model.compute_mean_track_length(),
        reprojection_error_px=model.compute_mean_reprojection_error(),
        images=sorted(model.image(i).name for i in model.reg_image_ids()),
    )


def _now() -> str:
    return f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"


def _recorded_options(config: Config, options: RunOptions) -> dict[str, object]:
    """All options as plain JSON. Those that readers need come first."""
    recorded = dataclasses.asdict(config) | {"enlarge": float(config.enlarge)}
    plain = dataclasses.asdict(options) | {"config": recorded}
    del plain["progress"]
    for name in ("reference", "masks", "rig"):  # to be found from any working directory
        path = getattr(options, name)
        plain[name] = path and path.absolute()
    needed = [field.name for field in dataclasses.fields(RecordedOptions)]
    plain = {name: plain[name] for name in [*needed, *plain]}
    return json.loads(json.dumps(plain, default=str))


def _pair_rows(
    counts: Mapping[Pair, PairCounts],
    handed_on: Collection[Pair],
    verified: Mapping[Pair, int],
    verdicts: Mapping[Pair, Verdict],
) -> list[PairRow]:
    """The rows of pairs, sorted. `verified` are the inliers that COLMAP found, by pair."""
    return [
        PairRow(
            pair=pair,
            status=PairStatus[each.status.name],
            tentative=each.num_tentative,
            inliers=each.num_inliers,
            planes=each.num_planes,
            handed_on=pair in handed_on,
            colmap_inliers=verified.get(pair, 0),
            view_graph=verdicts.get(pair),
        )
        for pair, each in sorted(counts.items())
    ]
