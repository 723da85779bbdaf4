"""A whole run in its work folder: from photos to a COLMAP model, a database and a report."""

import importlib.metadata
import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.external_matches import JoinedMatches, read_external_matches
from jaxsfm.colmap.intrinsics import Intrinsics, check_fits, parse_intrinsics
from jaxsfm.colmap.mapper import MapOptions
from jaxsfm.colmap.model_folders import write_models
from jaxsfm.colmap.poses import model_poses, read_poses
from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pair_selection import parse_pair_selection, selected_pairs
from jaxsfm.io.pairs import Pair, PairCounts, PairResult, best_pairs
from jaxsfm.io.store import SavedMatches, digest
from jaxsfm.io.weights import chosen_weights
from jaxsfm.io.work_folder import open_folder
from jaxsfm.matching.engines import chosen_engine
from jaxsfm.matching.pipeline import open_images
from jaxsfm.matching.retrieval import check_retrieval, describe_photos, nearest_pairs
from jaxsfm.options import Retrieval
from jaxsfm.report.page.after_run import page_after_run
from jaxsfm.report.run_inputs import RunIdentity, UsedWeights
from jaxsfm.report.run_report import RunReport, write_report
from jaxsfm.report.typed_json import from_json, to_json
from jaxsfm.runs.build_report import StageResults, evaluated, run_report
from jaxsfm.runs.job import Job, images_of, pairs_without
from jaxsfm.runs.run_options import RunOptions, check_options
from jaxsfm.sfm.reconstruction import Reconstructed, StageCache, reconstruct

logger = logging.getLogger("jaxsfm")


def run_folder(images: Path, out: Path, *, config: Config, options: RunOptions) -> dict[str, Json]:
    """Reconstruct a folder of photos; returns the content of `out`/report.json.

    `checks` in it is what the photos say of each model, and `RunReport.from_json(...).verdict` is
    the verdict that follows. See `reconstruct_folder`, which returns the report as an object.
    """
    return reconstruct_folder(images, out, config=config, options=options).to_json()


def reconstruct_folder(
    images: Path, out: Path, *, config: Config, options: RunOptions
) -> RunReport:
    """Reconstruct a folder of photos; returns the report, also written to `out`/report.json.

    Features, matches and finished stages are kept in `out` as soon as they are there, each under a
    key made of all that it depends on. So the same call continues an interrupted run, and a call
    with other photos or options uses again whatever does not depend on the change. `out`/sparse/0
    is the best model, and `out`/database.db is COLMAP's database.

    Args:
      images: folder of the photos.
      out: folder for the results; it is made if it does not exist.

    Raises:
      UserError: a photo, a file or an option cannot be used. What was computed is kept.
    """
    check_options(options)
    reference = read_poses(options.reference) if options.reference else None
    intrinsics = parse_intrinsics(options.intrinsics) if options.intrinsics else None
    usable, skipped = open_images(images, progress=options.progress)
    names = [*(image.name for image in usable), *skipped]
    selection = parse_pair_selection(options.pairs)
    pairs = selected_pairs(selection, (image.name for image in usable), names)
    _check_enough(images, usable, skipped)
    if intrinsics is not None:
        check_fits(intrinsics, {image.name: image.size for image in usable})
    external = read_external_matches(options.with_database, options.with_hloc, usable, intrinsics)
    weights = chosen_weights(options.network, config.backbone)
    if selection.retrieval:
        check_retrieval(options.retrieval, weights)
    relocalizer = weights.chosen_relocalizer(config)
    identity = RunIdentity(
        version=importlib.metadata.version("jaxsfm"),
        weights=weights.sha256,
        relocalizer=relocalizer and relocalizer.sha256,
        config=config.matching(),
        seed=options.seed,
        images={image.name: image.sha256 for image in usable},
    )
    seconds: dict[str, float] = {}
    with open_folder(out, to_json(identity)) as folder:
        job = Job(
            store=folder,
            weights=weights,
            config=config,
            engine=chosen_engine(options.engine),
            execution=options.execution,
            seed=options.seed,
            progress=options.progress,
        )
        skipped |= {i.name: why for i in usable if (why := folder.why_unusable(i)) is not None}
        if selection.retrieval:
            with _timed(seconds, "retrieval"):
                tried = [image for image in usable if image.name not in skipped]
                found, lost = _retrieve(job, tried, options.retrieval, selection.retrieval)
                pairs, skipped = sorted({*pairs, *found}), skipped | lost
        by_name = {image.name: image for image in usable if image.name not in skipped}
        pairs = pairs_without(pairs, skipped)
        with _timed(seconds, "extraction"):
            results = {p: r.counts for p in pairs if (r := folder.load_matches(p)) is not None}
            missing = [pair for pair in pairs if pair not in results]
            if results:
                logger.info("%d of %d pairs have been matched before", len(results), len(pairs))
            skipped |= job.extract_missing(images_of(missing, by_name))
            missing = pairs_without(missing, skipped)
            good = [image for image in usable if image.name not in skipped]
            _check_enough(images, good, skipped)
        with _timed(seconds, "matching"):
            for result in job.match_missing(by_name, missing):
                results[result.pair] = result.counts
        chosen = sorted(_verified_pairs(results, options.best_pairs))
        ours = SavedMatches(folder, chosen)
        handed_on = JoinedMatches(ours, external, {image.name for image in good})
        matches_key = digest(
            [[*pair, folder.match_key(pair)] for pair in chosen],
            external.about and external.about["sha256"],
        )
        stages = StageCache(folder, matches_key)
        with folder.publish() as target:
            made, took = _map(target, good, handed_on, intrinsics, stages, config, options)
            seconds |= took
            report = run_report(
                StageResults(
                    folder=images,
                    identity=identity,
                    usable=good,
                    skipped=skipped,
                    results=results,
                    handed_on=handed_on,
                    external=external,
                    reconstructed=made,
                    weights=from_json(UsedWeights, weights.described(config)),
                    seconds=seconds,
                ),
                config=config,
                options=options,
            )
            if reference is not None and made.models:
                report = evaluated(report, model_poses(made.models[0]), reference)
            write_report(target, report)
        if not options.keep_features:
            folder.drop_features()
        # The page is written before the lock is released: another run there would replace the files
        # that it shows.
        page_after_run(out if made.models or not (out / "sparse").exists() else out / "failed")
        return report


def _map(
    target: Path,
    images: list[ImageFile],
    matches: Mapping[Pair, PairResult],
    intrinsics: Intrinsics | None,
    stages: StageCache,
    config: Config,
    options: RunOptions,
) -> tuple[Reconstructed, dict[str, float]]:
    """Write the database and the models into `target`; returns also the seconds of each stage."""
    start, seconds = time.monotonic(), {}
    passes = config.refinement.passes if config.refinement else 0
    quiet = not options.progress
    with (
        tqdm(total=len(images), desc="mapping", unit="image", disable=quiet) as bar,
        tqdm(total=passes, desc="refinement", unit="pass", disable=quiet or not passes) as turns,
    ):

        def on_image() -> None:
            bar.update(bar.n < len(images))  # several models may share images

        def on_mapped() -> None:
            seconds["mapping"] = time.monotonic() - start
            turns.reset()

        def on_pass() -> None:
            turns.update(turns.n < passes)

        made = reconstruct(
            images,
            matches,
            target / "database.db",
            config=config,
            intrinsics=intrinsics,
            options=MapOptions(
                mapper=options.mapper,
                refine_intrinsics=options.refines,
                seed=options.seed,
                threads=options.threads,
            ),
            kept=stages,
            on_image=on_image,
            on_mapped=on_mapped,
            on_pass=on_pass,
        )
        if made.models:
            # The global mapper does not report images before it ends.
            bar.update(made.models[0].num_reg_images() - bar.n)
    if passes:
        seconds["refinement"] = time.monotonic() - start - seconds["mapping"]
    write_models(made.models, target / "sparse")
    write_models(made.alternative, target / "alternative")
    return made, seconds


def _check_enough(folder: Path, images: list[ImageFile], skipped: dict[str, str]) -> None:
    if len(images) < 2:
        why = f"; skipped: {next(iter(skipped.values()))}" if skipped else ""
        raise UserError(f"{folder}: {len(images)} usable images, at least 2 are needed{why}")


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.monotonic()
    yield
    seconds[stage] = time.monotonic() - start


def _retrieve(
    job: Job, images: list[ImageFile], kind: Retrieval, k: int
) -> tuple[list[Pair], dict[str, str]]:
    """Pairs of each image with its k most similar ones, and why images have no descriptor."""
    total, quiet = len(images), not job.progress
    with tqdm(total=total, desc="retrieval", unit="image", disable=quiet) as bar:
        found = describe_photos(
            job.weights,
            images,
            kind=kind,
            store=job.store,
            execution=job.execution,
            on_image=bar.update,
        )
    for image, error in found.lost:
        job.store.record_failure(image, error)
    lost = {image.name: str(error) for image, error in found.lost}
    return nearest_pairs(found.vectors, k), lost


def _verified_pairs(results: dict[Pair, PairCounts], n: int | None) -> set[Pair]:
    """The pairs with inliers; with `n`, only the best `n` pairs of each image."""
    counts = {pair: result.num_inliers for pair, result in results.items()}
    if n is None:
        return {pair for pair, count in counts.items() if count}
    return best_pairs(counts, n)
