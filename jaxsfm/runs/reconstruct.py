"""A whole run in its work folder: photos in, COLMAP model, database and report out."""

import importlib.metadata
import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.external_matches import Beside, read_given
from jaxsfm.colmap.intrinsics import Intrinsics, check_fits, parse_intrinsics
from jaxsfm.colmap.mapper import MapOptions
from jaxsfm.colmap.models import write_models
from jaxsfm.colmap.poses import model_poses, read_poses
from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pair_selection import parse_pair_selection, selected_pairs
from jaxsfm.io.pairs import Pair, PairCounts, PairResult, best_pairs
from jaxsfm.io.store import SavedMatches, digest
from jaxsfm.io.weights import Weights, chosen_weights
from jaxsfm.io.work_folder import WorkFolder, open_folder
from jaxsfm.matching.pipeline import open_images
from jaxsfm.matching.retrieval import check_retrieval, describe_photos, nearest_pairs
from jaxsfm.report.page.after_run import page_after_run
from jaxsfm.report.run_inputs import RunIdentity, UsedWeights
from jaxsfm.report.run_report import RunReport, write_report
from jaxsfm.report.typed_json import from_json
from jaxsfm.runs.compute_missing import extract_missing, match_missing
from jaxsfm.runs.report import StageResults, evaluated, run_report
from jaxsfm.runs.run_options import RunOptions, check_options
from jaxsfm.sfm.reconstruction import Reconstructed, reconstruct
from jaxsfm.sfm.stages import Kept

logger = logging.getLogger("jaxsfm")


def run_folder(
    images: Path, out: Path, *, config: Config, options: RunOptions
) -> dict[str, object]:
    """Reconstruct a folder of photos; returns the content of `out`/report.json.

    See `reconstruct_folder`, which returns the report as an object.
    """
    return reconstruct_folder(images, out, config=config, options=options).to_json()


def reconstruct_folder(
    images: Path, out: Path, *, config: Config, options: RunOptions
) -> RunReport:
    """Reconstruct a folder of photos; returns the report, also written to `out`/report.json.

    Features, matches and finished stages are kept in `out` as they are made, each under what it
    depends on: after an interruption, or with other photos or options, the same call goes on with
    what still holds. `out`/sparse/0 is the best model, `out`/database.db the database.

    Raises:
      UserError: what was given cannot be used. Nothing already computed is lost.
    """
    check_options(options)
    reference = read_poses(options.reference) if options.reference else None
    intrinsics = parse_intrinsics(options.intrinsics) if options.intrinsics else None
    usable, skipped = open_images(images, progress=options.progress)
    names = [*(image.name for image in usable), *skipped]
    plan = parse_pair_selection(options.pairs)
    pairs = selected_pairs(plan, (image.name for image in usable), names)
    _check_enough(images, usable, skipped)
    if intrinsics is not None:
        check_fits(intrinsics, {image.name: image.size for image in usable})
    given = read_given(options.with_database, options.with_hloc, usable, intrinsics)
    weights = chosen_weights(options.network, config.backbone)
    if plan.retrieval:
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
    with open_folder(out, identity.to_json()) as folder:
        skipped |= {i.name: why for i in usable if (why := folder.why_unusable(i)) is not None}
        if plan.retrieval:
            with _timed(seconds, "retrieval"):
                tried = [image for image in usable if image.name not in skipped]
                found, lost = _retrieve(folder, weights, tried, plan.retrieval, options)
                pairs, skipped = sorted({*pairs, *found}), skipped | lost
        by_name = {image.name: image for image in usable if image.name not in skipped}
        pairs = [pair for pair in pairs if pair[0] in by_name and pair[1] in by_name]
        with _timed(seconds, "extraction"):
            results = {p: r.counts for p in pairs if (r := folder.load_matches(p)) is not None}
            missing = [pair for pair in pairs if pair not in results]
            if results:
                logger.info("%d of %d pairs have been matched before", len(results), len(pairs))
            skipped |= extract_missing(folder, weights, by_name, missing, config, options)
            missing = [pair for pair in missing if not skipped.keys() & set(pair)]
            good = [image for image in usable if image.name not in skipped]
            _check_enough(images, good, skipped)
        with _timed(seconds, "matching"):
            for result in match_missing(folder, weights, by_name, missing, config, options):
                results[result.pair] = result.counts
        chosen = sorted(_choose(results, options.best_pairs))
        ours = SavedMatches(folder, chosen)
        handed_on = Beside(ours, given, {image.name for image in good})
        matches_key = digest(
            [[*pair, folder.match_key(pair)] for pair in chosen],
            given.about and given.about["sha256"],
        )
        kept = Kept(folder, matches_key)
        with folder.publish() as fresh:
            made = _map(fresh, good, handed_on, intrinsics, kept, config, options, seconds)
            report = run_report(
                StageResults(
                    folder=images,
                    identity=identity,
                    usable=good,
                    skipped=skipped,
                    results=results,
                    handed_on=handed_on,
                    external=given,
                    reconstructed=made,
                    weights=from_json(UsedWeights, weights.described(config)),
                    seconds=seconds,
                ),
                config=config,
                options=options,
            )
            if reference is not None and made.models:
                report = evaluated(report, model_poses(made.models[0]), reference)
            write_report(fresh, report)
        if not options.keep_features:
            folder.drop_features()
        # While the folder is ours: another run there would replace what the page shows.
        page_after_run(out if made.models or not (out / "sparse").exists() else out / "failed")
        return report


def _map(
    fresh: Path,
    images: list[ImageFile],
    matches: Mapping[Pair, PairResult],
    intrinsics: Intrinsics | None,
    kept: Kept,
    config: Config,
    options: RunOptions,
    seconds: dict[str, float],
) -> Reconstructed:
    """Database and models, written into `fresh`."""
    start = time.monotonic()
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
            fresh / "database.db",
            config=config,
            intrinsics=intrinsics,
            options=MapOptions(
                mapper=options.mapper,
                refine_intrinsics=options.refines,
                seed=options.seed,
                threads=options.threads,
            ),
            kept=kept,
            on_image=on_image,
            on_mapped=on_mapped,
            on_pass=on_pass,
        )
        if made.models:
            bar.update(
                made.models[0].num_reg_images() - bar.n
            )  # the global mapper tells at the end
    if passes:
        seconds["refinement"] = time.monotonic() - start - seconds["mapping"]
    write_models(made.models, fresh / "sparse")
    return made


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
    folder: WorkFolder, weights: Weights, images: list[ImageFile], k: int, options: RunOptions
) -> tuple[list[Pair], dict[str, str]]:
    """Each image with its k most similar ones; why some cannot be described."""
    total, quiet = len(images), not options.progress
    with tqdm(total=total, desc="retrieval", unit="image", disable=quiet) as bar:
        found = describe_photos(
            weights,
            images,
            kind=options.retrieval,
            store=folder,
            execution=options.execution,
            on_image=bar.update,
        )
    for image, error in found.lost:
        folder.record_failure(image, error)
    lost = {image.name: str(error) for image, error in found.lost}
    return nearest_pairs(found.vectors, k), lost


def _choose(results: dict[Pair, PairCounts], n: int | None) -> set[Pair]:
    counts = {pair: result.num_inliers for pair, result in results.items()}
    if n is None:
        return {pair for pair, count in counts.items() if count}
    return best_pairs(counts, n)
