"""A whole run in its work folder: photos in, COLMAP model, database and report out."""

import dataclasses
import importlib.metadata
import json
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

from jaxsfm.config import Config
from jaxsfm.engines import chosen_engine
from jaxsfm.errors import UserError
from jaxsfm.evaluation import evaluate
from jaxsfm.extraction import image_features
from jaxsfm.host import interrupt
from jaxsfm.host.colmap import write_models
from jaxsfm.host.features import ImageFeatures, image_room
from jaxsfm.host.given import Beside, read_given
from jaxsfm.host.images import ImageError, ImageFile
from jaxsfm.host.intrinsics import Intrinsics, check_fits, parse_intrinsics
from jaxsfm.host.mapping import MapOptions
from jaxsfm.host.pairs import Pair, PairCounts, PairResult, best_pairs, exhaustive_pairs, read_pairs
from jaxsfm.host.poses import model_poses, read_poses
from jaxsfm.host.versions import versions
from jaxsfm.host.weights import Weights, chosen_weights
from jaxsfm.host.workfolder import SavedMatches, WorkFolder, open_folder, write_atomic
from jaxsfm.page.after_run import page_after_run
from jaxsfm.pipeline import Reconstructed, open_images, reconstruct
from jaxsfm.report import lost_images, model_figures, pair_figures
from jaxsfm.run_options import RunOptions, check_options

T = TypeVar("T")


def run_folder(images: Path, out: Path, *, config: Config, options: RunOptions) -> dict[str, Any]:
    """Reconstruct a folder of photos; returns the report, also written to `out`/report.json.

    Features and matches are kept in `out` as they are made: after an interruption the same call
    goes on. `out`/sparse/0 is the best model, `out`/database.db the database.

    Raises:
      UserError: what was given cannot be used. Nothing already computed is lost.
    """
    check_options(options)
    reference = read_poses(options.reference) if options.reference else None
    intrinsics = parse_intrinsics(options.intrinsics) if options.intrinsics else None
    usable, skipped = open_images(images, progress=options.progress)
    names = [*(image.name for image in usable), *skipped]
    pairs = (
        exhaustive_pairs(image.name for image in usable)
        if options.pairs == "exhaustive"
        else read_pairs(Path(options.pairs), names)
    )
    _check_enough(images, usable, skipped)
    if intrinsics is not None:
        check_fits(intrinsics, {image.name: image.size for image in usable})
    given = read_given(options.with_database, options.with_hloc, usable, intrinsics)
    weights = chosen_weights(options.network, config.backbone)
    relocalizer = weights.chosen_relocalizer(config)
    identity = {
        "version": importlib.metadata.version("jaxsfm"),
        "weights": weights.sha256,
        "relocalizer": relocalizer and relocalizer.sha256,
        "config": config.matching(),
        "seed": options.seed,
        "images": {image.name: image.sha256 for image in usable},
    }
    seconds: dict[str, float] = {}
    with open_folder(out, identity) as folder:
        known_bad = folder.unusable()
        skipped |= {i.name: known_bad[i.sha256] for i in usable if i.sha256 in known_bad}
        by_name = {image.name: image for image in usable if image.name not in skipped}
        pairs = [pair for pair in pairs if pair[0] in by_name and pair[1] in by_name]
        with _timed(seconds, "extraction"):
            results = {p: r.counts for p in pairs if (r := folder.load_matches(p)) is not None}
            missing = [pair for pair in pairs if pair not in results]
            skipped |= _extract(folder, weights, by_name, missing, config, options)
            missing = [pair for pair in missing if not skipped.keys() & set(pair)]
            good = [image for image in usable if image.name not in skipped]
            _check_enough(images, good, skipped)
        with _timed(seconds, "matching"):
            for result in _match(folder, weights, by_name, missing, config, options):
                results[result.pair] = result.counts
        with folder.publish() as fresh:
            chosen = _choose(results, options.best_pairs)
            ours = SavedMatches(folder, sorted(chosen))
            handed_on = Beside(ours, given, {image.name for image in good})
            made = _map(fresh, good, handed_on, intrinsics, config, options, seconds)
            models, verified = made.models, made.verified
            untrusted = [pair for pair, v in made.verdicts.items() if not v.trusted]
            figures = [model_figures(model) for model in models]
            counts = given.counts(results)
            report: dict[str, Any] = {
                "version": identity["version"],
                "versions": versions(),
                "finished": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
                "weights": weights.described(config),
                "options": {
                    "config": dataclasses.asdict(config),
                    **{k: v for k, v in dataclasses.asdict(options).items() if k != "progress"},
                    # Read again from anywhere, as the photos' folder is.
                    "reference": options.reference and options.reference.absolute(),
                },
                "images": {
                    "folder": str(images.absolute()),
                    "found": len(names),
                    "usable": len(good),
                    "skipped": skipped,
                },
                "pairs": {
                    "tried": len(results),
                    "verified": sum(r.num_inliers > 0 for r in results.values()),
                    "handed_on": len(handed_on),
                    "trusted": len(verified) - len(untrusted) if made.verdicts else None,
                    "overflowed": sum(r.num_dropped > 0 for r in results.values()),
                    "each": [
                        pair_figures(pair, each, handed_on, verified, made.verdicts)
                        for pair, each in sorted(counts.items())
                    ],
                },
                "given": given.about,
                "models": figures,
                "mapping": [dataclasses.asdict(attempt) for attempt in made.attempts],
                "refinement": [each and dataclasses.asdict(each) for each in made.refinement],
                "lost": lost_images(
                    [image.name for image in good],
                    figures[0]["images"] if figures else [],
                    counts,
                    verified,
                    untrusted,
                ),
                "seconds": seconds,
            }
            if reference is not None and models:
                try:
                    report["evaluation"] = evaluate(model_poses(models[0]), reference).as_dict()
                except UserError as error:  # the model is there; only its comparison is not
                    report["evaluation_failed"] = str(error)
            text = json.dumps(report, indent=1, default=str)
            write_atomic(fresh / "report.json", text.encode())
        folder.drop_features()
        # While the folder is ours: another run there would replace what the page shows.
        page_after_run(out if models or not (out / "sparse").exists() else out / "failed")
        return report


def _map(
    fresh: Path,
    images: list[ImageFile],
    matches: Mapping[Pair, PairResult],
    intrinsics: Intrinsics | None,
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


def _bar(items: Iterable[T], total: int, stage: str, unit: str, options: RunOptions) -> Iterator[T]:
    yield from tqdm(items, total=total, desc=stage, unit=unit, disable=not options.progress)
    interrupt.check()


def _extract(
    folder: WorkFolder,
    weights: Weights,
    images: dict[str, ImageFile],
    pairs: list[Pair],
    config: Config,
    options: RunOptions,
) -> dict[str, str]:
    """Features of every image of `pairs` that has none yet; why some have none."""
    needed = sorted({name for pair in pairs for name in pair})
    todo = [images[name] for name in needed if not folder.has_features(images[name])]
    skipped: dict[str, str] = {}
    if not todo:
        return skipped
    engine = chosen_engine(options.engine)
    stream = engine.extracted(weights, todo, config=config, execution=options.execution)
    for image, found in _bar(stream, len(todo), "extraction", "image", options):
        if isinstance(found, ImageError):
            folder.mark_unusable(image, str(found))
            skipped[image.name] = str(found)
        else:
            folder.save_features(found)
    return skipped


def _match(
    folder: WorkFolder,
    weights: Weights,
    images: dict[str, ImageFile],
    pairs: list[Pair],
    config: Config,
    options: RunOptions,
) -> Iterator[PairResult]:
    """Matches of pairs, saved as they are made."""

    def load(name: str) -> ImageFeatures:
        found = folder.load_features(images[name])
        if found is None:  # damaged or deleted under us: it is only a cache
            found = image_features(weights, images[name], config=config)
            folder.save_features(found)
        return found

    rooms = {name: image_room(image, config=config) for name, image in images.items()}
    stream = chosen_engine(options.engine).matched(
        load, rooms, pairs, config=config, seed=options.seed, execution=options.execution
    )
    for result in _bar(stream, len(pairs), "matching", "pair", options):
        folder.save_matches(result)
        yield result


def _choose(results: dict[Pair, PairCounts], n: int | None) -> set[Pair]:
    counts = {pair: result.num_inliers for pair, result in results.items()}
    if n is None:
        return {pair for pair, count in counts.items() if count}
    return best_pairs(counts, n)
