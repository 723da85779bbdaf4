"""Reconstruct a Strecha set by a method, in a work folder."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from jaxsfm.bench.figures import write_json
from jaxsfm.bench.methods import NAIVE, method_config
from jaxsfm.bench.naive import match_pairs_naively
from jaxsfm.bench.options import StrechaOptions
from jaxsfm.bench.strecha_sets import StrechaSet
from jaxsfm.colmap.intrinsics import parse_intrinsics
from jaxsfm.colmap.mapper import MapOptions, build_models
from jaxsfm.colmap.model_folders import write_models
from jaxsfm.colmap.poses import read_model
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions, read_two_views
from jaxsfm.io.pairs import best_pairs, exhaustive_pairs
from jaxsfm.io.weights import chosen_weights
from jaxsfm.matching.pipeline import open_images
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.reconstruction import reconstruct

if TYPE_CHECKING:
    import pycolmap

Made: TypeAlias = "tuple[pycolmap.Reconstruction | None, dict[str, float]]"
"""The largest model, and the seconds of each stage."""


def set_model(each: StrechaSet, method: str, work: Path, options: StrechaOptions) -> Made:
    """The largest model of a set, also written to `work`/sparse; and the seconds of each stage."""
    work.mkdir(parents=True, exist_ok=True)
    if method == "rootsift":
        return _run_rootsift(each, work, options)
    if method == NAIVE:
        return _run_naive(each, work, options)
    return _run_method(each, method, work, options)


def _run_rootsift(each: StrechaSet, work: Path, options: StrechaOptions) -> Made:
    """The model of a set by COLMAP's own features."""
    photos, database = each.folder / "images", work / "database.db"
    images, _ = open_images(photos)
    start = time.monotonic()
    known = options.intrinsics == "known"
    camera = parse_intrinsics(each.camera) if known else None
    seed, threads = options.seed, options.threads
    verification = VerificationOptions(seed=seed, threads=threads)
    write_rootsift_database(database, photos, images, camera, verification)
    mapping = MapOptions(refine_intrinsics=not known, seed=seed, threads=threads)
    models, _ = build_models(database, read_two_views(database), mapping)
    write_models(models, work / "sparse")
    return models[0] if models else None, {"all": time.monotonic() - start}


def _run_method(each: StrechaSet, method: str, work: Path, options: StrechaOptions) -> Made:
    """The model of a set by one of our methods, for which `work` is its work folder."""
    run = RunOptions(
        intrinsics=each.camera if options.intrinsics == "known" else None,
        network=options.network,
        seed=options.seed,
        threads=options.threads,
        best_pairs=options.best_pairs,
        progress=True,
    )
    photos, config = each.folder / "images", method_config(method)
    report = reconstruct_folder(photos, work, config=config, options=run)
    model = read_model(work / "sparse" / "0") if report.models else None
    return model, report.seconds | _matching_seconds(work, report.seconds)


def _run_naive(each: StrechaSet, work: Path, options: StrechaOptions) -> Made:
    """The model of a set from matches of pixels."""
    config, start = method_config(NAIVE), time.monotonic()
    weights = chosen_weights(options.network, config.backbone)
    images = {image.name: image for image in open_images(each.folder / "images")[0]}
    pairs, seed = exhaustive_pairs(images), options.seed
    matched = match_pairs_naively(weights, images, pairs, config=config, seed=seed)
    results = {result.pair: result for result in matched}
    counts = {pair: result.num_inliers for pair, result in results.items()}
    kept = sorted(best_pairs(counts, options.best_pairs or len(images)))
    known = options.intrinsics == "known"
    made = reconstruct(
        list(images.values()),
        {pair: results[pair] for pair in kept},
        work / "database.db",
        config=config,
        intrinsics=parse_intrinsics(each.camera) if known else None,
        options=MapOptions(refine_intrinsics=not known, seed=seed, threads=options.threads),
    )
    write_models(made.models, work / "sparse")
    return made.models[0] if made.models else None, {"all": time.monotonic() - start}


def _matching_seconds(work: Path, stages: dict[str, float]) -> dict[str, float]:
    """Seconds of extraction and matching in a work folder, also if an earlier run did them.

    A stage that is reused took its time once. The longest time measured so far is what counts, and
    it is stored in the work folder.
    """
    path = work / "bench_seconds.json"
    try:
        before = json.loads(path.read_text())
    except (OSError, ValueError):
        before = {}
    spent = {
        stage: max(float(before.get(stage, 0.0)), stages[stage])
        for stage in ("extraction", "matching")
    }
    write_json(path, spent)
    return spent
