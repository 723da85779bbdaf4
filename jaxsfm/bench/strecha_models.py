"""Reconstruct a Strecha set by a method, in a work folder."""

import dataclasses
import json
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.bench.figures import write_json
from jaxsfm.bench.inputs import StrechaSet
from jaxsfm.bench.methods import (
    LIGHTGLUE,
    MAPPERS,
    NAIVE,
    REFINED_ROOTSIFT,
    ROOTSIFT,
    method_config,
)
from jaxsfm.bench.other_methods import match_pairs_naively, write_lightglue_database
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.given_cameras import parse_intrinsics
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import build_models
from jaxsfm.colmap.model_files import read_model, write_models
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions, read_two_views
from jaxsfm.errors import writing
from jaxsfm.io.atomic import atomic_folder
from jaxsfm.io.entries import RECORD
from jaxsfm.io.pairs import Pair, best_pairs, exhaustive_pairs
from jaxsfm.io.photos import Photos
from jaxsfm.io.weights import chosen_weights
from jaxsfm.matching.pipeline import open_images
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice
from jaxsfm.report.run_report import RunReport
from jaxsfm.runs.job import timed
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.refined_models import Believed, refine_models
from jaxsfm.sfm.road import reconstruct

if TYPE_CHECKING:
    import pycolmap

SECONDS = "bench_seconds.json"
"""The file in a work folder that holds the longest times of extraction and matching."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MethodRun:
    """How a method is run on a set."""

    method: str
    known: bool = True
    """Whether the cameras are those of the set and stay fixed; otherwise they are guessed."""
    network: WeightsChoice = USUAL_WEIGHTS
    seed: int = 0
    threads: int = -1
    best_pairs: int | None = None
    """Map only so many pairs of each image; RootSIFT maps all."""
    max_size: int | None = None
    """The longer side of the working images, pixels; None keeps the method's own."""

    def cameras(self, each: StrechaSet) -> Cameras:
        """What is known of the cameras of a set."""
        known = parse_intrinsics(each.camera) if self.known else None
        return Cameras(known=known, sharing="photo")

    @property
    def mapping(self) -> MapOptions:
        """The options of the mapper."""
        return MapOptions(refine_intrinsics=not self.known, seed=self.seed, threads=self.threads)


class SetModels(NamedTuple):
    """A method's reconstruction of a set."""

    models: "list[pycolmap.Reconstruction]"
    """The one with most images first; empty if there is none."""
    seconds: dict[str, float]
    """The time of each stage."""
    report: RunReport | None
    """What the run says of its models; None for methods that are not runs of ours."""
    alternative: "pycolmap.Reconstruction | None" = None
    """The best model that joins the photos in another way."""


def set_models(each: StrechaSet, work: Path, run: MethodRun) -> SetModels:
    """Reconstruct a set. The models are also in `work`/sparse."""
    work.mkdir(parents=True, exist_ok=True)
    if run.method == ROOTSIFT:
        return _run_rootsift(each, work, run)
    if run.method == REFINED_ROOTSIFT:
        return _run_refined_rootsift(each, work, run)
    if run.method == LIGHTGLUE:
        return _run_lightglue(each, work, run)
    if run.method == NAIVE:
        return _run_naive(each, work, run)
    return _run_method(each, work, run)


def take_matches(work: Path, other: Path) -> None:
    """Begin a work folder with the matches of another one that has the same photos.

    A folder that is there already stays as it is. A run in the new folder uses those matches that
    its own settings would give, and computes the rest.
    """
    if work.exists() or not (other / RECORD).is_file() or not (other / "matches").is_dir():
        return
    with writing(f"--out {work}"), atomic_folder(work) as fresh:
        shutil.copytree(other / "matches", fresh / "matches")
        for name in (RECORD, SECONDS):
            if (other / name).is_file():
                shutil.copyfile(other / name, fresh / name)


def map_rootsift(
    photos: Path,
    work: Path,
    cameras: Cameras,
    mapping: MapOptions,
    *,
    pairs: list[Pair] | None = None,
    max_size: int | None = None,
) -> SetModels:
    """The models of photos by COLMAP's own features, verification and mapper.

    Args:
      photos, work: the folder of the photos, and one for the database and for sparse/.
      pairs: those to match; None: all.
      max_size: the longer side of the working images, pixels; None: COLMAP's own.
    """
    database, (images, _) = work / "database.db", open_images(photos)
    seconds: dict[str, float] = {}
    verification = VerificationOptions(seed=mapping.seed, threads=mapping.threads)
    with timed(seconds, "matching"):  # COLMAP does not say how long its extraction takes
        write_rootsift_database(
            database, photos, images, cameras, verification, pairs=pairs, max_size=max_size
        )
    return _mapped(database, work, mapping, seconds)


def _mapped(
    database: Path, work: Path, mapping: MapOptions, seconds: dict[str, float]
) -> SetModels:
    """The models of the verified pairs in a database."""
    with timed(seconds, "mapping"):
        models = build_models(database, read_two_views(database), mapping)
    write_models(models, work / "sparse")
    return SetModels(models, seconds, None)


def _run_rootsift(each: StrechaSet, work: Path, run: MethodRun) -> SetModels:
    """The models of a set by COLMAP's own features."""
    photos, cameras = each.folder / "images", run.cameras(each)
    return map_rootsift(photos, work, cameras, run.mapping, max_size=run.max_size)


def _run_refined_rootsift(each: StrechaSet, work: Path, run: MethodRun) -> SetModels:
    """The models of a set by COLMAP's own features, with our refinement."""
    made, config = _run_rootsift(each, work, run), method_config("default", max_size=run.max_size)
    photos = Photos(open_images(each.folder / "images")[0], config)
    options = dataclasses.replace(run.mapping, scale=photos.median_scale())
    with timed(made.seconds, "refinement"):
        refined = refine_models(
            made.models,
            photos,
            Believed(work / "database.db", {}),
            config=config,
            options=options,
        )
    write_models(refined.models, work / "sparse")
    return made._replace(models=refined.models)


def _run_method(each: StrechaSet, work: Path, run: MethodRun) -> SetModels:
    """The models of a set by one of our methods, for which `work` is its work folder."""
    options = RunOptions(
        pairs="exhaustive",  # as RootSIFT
        intrinsics=each.camera if run.known else None,
        cameras="auto" if run.known else "photo",
        network=run.network,
        seed=run.seed,
        threads=run.threads,
        best_pairs=run.best_pairs,
        mapper=MAPPERS.get(run.method, "incremental"),
        progress=True,
    )
    photos, config = each.folder / "images", method_config(run.method, max_size=run.max_size)
    report = reconstruct_folder(photos, work, config=config, options=options)
    models = [read_model(work / "sparse" / str(k)) for k in range(len(report.models))]
    other = work / "alternative" / "0"
    return SetModels(
        models,
        report.seconds | _matching_seconds(work, report.seconds),
        report,
        read_model(other) if other.is_dir() else None,
    )


def _run_lightglue(each: StrechaSet, work: Path, run: MethodRun) -> SetModels:
    """The models of a set by ALIKED keypoints and LightGlue's matches."""
    images, database = open_images(each.folder / "images")[0], work / "database.db"
    seconds: dict[str, float] = {}
    options = VerificationOptions(seed=run.seed, threads=run.threads)
    write_lightglue_database(database, images, run.cameras(each), options, seconds=seconds)
    return _mapped(database, work, run.mapping, seconds)


def _run_naive(each: StrechaSet, work: Path, run: MethodRun) -> SetModels:
    """The models of a set from matches of pixels."""
    config, start = method_config(NAIVE, max_size=run.max_size), time.monotonic()
    weights = chosen_weights(run.network, config.backbone)
    images = {image.name: image for image in open_images(each.folder / "images")[0]}
    pairs = exhaustive_pairs(images)
    matched = match_pairs_naively(weights, images, pairs, config=config, seed=run.seed)
    results = {result.pair: result for result in matched}
    counts = {pair: result.num_inliers for pair, result in results.items()}
    kept = sorted(best_pairs(counts, run.best_pairs or len(images)))
    made = reconstruct(
        list(images.values()),
        {pair: results[pair] for pair in kept},
        work / "database.db",
        config=config,
        cameras=run.cameras(each),
        options=run.mapping,
    )
    write_models(made.models, work / "sparse")
    return SetModels(made.models, {"all": time.monotonic() - start}, None)


def _matching_seconds(work: Path, stages: dict[str, float]) -> dict[str, float]:
    """Seconds of extraction and matching in a work folder, also if an earlier run did them.

    A stage that is reused took its time once. The longest time measured so far is what counts, and
    it is stored in the work folder.
    """
    path = work / SECONDS
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = {}
    spent = {
        stage: max(float(before.get(stage, 0.0)), stages[stage])
        for stage in ("extraction", "matching")
    }
    write_json(path, spent)
    return spent
