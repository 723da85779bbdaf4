"""`bench strecha`: the paper's comparison on standard scenes (Strecha et al., CVPR 2008)."""

import dataclasses
import json
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NotRequired, TypedDict

import numpy as np

from jaxsfm.bench.figures import collect
from jaxsfm.bench.methods import RUN_ABLATED, method_config
from jaxsfm.bench.options import StrechaOptions
from jaxsfm.bench.strecha_sets import StrechaSet, read_sets
from jaxsfm.colmap.intrinsics import parse_intrinsics
from jaxsfm.colmap.mapper import MapOptions, build_models
from jaxsfm.colmap.model_folders import write_models
from jaxsfm.colmap.poses import model_poses, read_model
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions, read_two_views
from jaxsfm.config import preset
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.versions import package_versions
from jaxsfm.matching.pipeline import open_images
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.evaluation import evaluate

METHODS = ("rootsift", "grid", "reloc", "learned", "default", "robust", *RUN_ABLATED)
BASELINE = "rootsift"
"""The method that the others are compared with."""
PUBLISHED = (
    "published (Widya et al. 2018, mean over six full-size sets): "
    "DoG + RootSIFT 0.17 m, 0.90 deg; dense + relocalization 0.59 m, 2.27 deg"
)


class StrechaRow(TypedDict):
    """The figures of one set and one method."""

    set: str
    method: str
    registered: int
    points: NotRequired[int]
    observations: NotRequired[int]
    track_length: NotRequired[float]
    reprojection_error_px: NotRequired[float]
    stages: NotRequired[dict[str, float]]
    """Seconds of each stage of one of our methods."""
    seconds: float
    images: int
    """The number of reference poses."""
    position: NotRequired[dict[str, float]]
    """Mean, median and largest position error, units of the reference."""
    rotation_deg: NotRequired[dict[str, float]]
    focal_error_percent: NotRequired[float]
    """The largest error of a focal length."""
    not_evaluated: NotRequired[str]
    """Why a model could not be compared with the reference."""


class MethodRatios(TypedDict):
    """Figures of a method divided by those of the baseline."""

    sets: dict[str, dict[str, float]]
    mean: dict[str, float]


class StrechaFigures(TypedDict):
    """The figures of the benchmark, as JSON."""

    benchmark: str
    versions: dict[str, str]
    intrinsics: str
    seed: int
    rows: list[StrechaRow]
    ratios: dict[str, MethodRatios]
    published: str


def _run_rootsift(each: StrechaSet, work: Path, options: StrechaOptions) -> StrechaRow:
    """Reconstruct a set with COLMAP's own features; the model goes to `work`/sparse."""
    work.mkdir(parents=True, exist_ok=True)
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
    row = _row(each, "rootsift", work if models else None)
    row["seconds"] = time.monotonic() - start
    return row


def _run_method(each: StrechaSet, method: str, work: Path, options: StrechaOptions) -> StrechaRow:
    """Reconstruct a set with one of our methods, in the work folder `work`."""
    run = RunOptions(
        intrinsics=each.camera if options.intrinsics == "known" else None,
        network=options.network,
        seed=options.seed,
        threads=options.threads,
        progress=True,
    )
    photos, config = each.folder / "images", method_config(method)
    report = reconstruct_folder(photos, work, config=config, options=run)
    row = _row(each, method, work if report.models else None)
    stages = report.seconds
    row["stages"] = stages | _matching_seconds(work, stages)
    row["seconds"] = sum(row["stages"].values())
    return row


def _row(each: StrechaSet, method: str, work: Path | None) -> StrechaRow:
    """The figures of the largest model in a work folder; None stands for no model."""
    row: StrechaRow = {
        "set": each.folder.name,
        "method": method,
        "registered": 0,
        "seconds": 0.0,
        "images": len(each.truth),
    }
    if work is None:
        return row
    model = read_model(work / "sparse" / "0")
    row["registered"] = model.num_reg_images()
    row["points"] = model.num_points3D()
    row["observations"] = model.compute_num_observations()
    row["track_length"] = model.compute_mean_track_length()
    row["reprojection_error_px"] = model.compute_mean_reprojection_error()
    try:
        errors = evaluate(model_poses(model), each.truth)
    except UserError as error:
        row["not_evaluated"] = str(error)
        return row
    row["position"], row["rotation_deg"] = errors.position, errors.rotation_deg
    focals = [
        model.cameras[model.image(i).camera_id].mean_focal_length() for i in model.reg_image_ids()
    ]
    error_of_focal = np.max(np.abs(np.asarray(focals) / each.focal - 1))
    row["focal_error_percent"] = 100 * float(error_of_focal)
    return row


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
    write_atomic(path, json.dumps(spent).encode())
    return spent


def _work_name(method: str) -> str:
    """The name of a method's work folder.

    Methods that differ from the preset `default` only after mapping share its matches, and so its
    work folder.
    """
    if method == "rootsift":
        return method
    config = method_config(method)
    usual = dataclasses.replace(preset("default"), keypoints=config.keypoints)
    return f"dense-{config.keypoints}" if config.matching() == usual.matching() else method


def bench_strecha(options: StrechaOptions) -> StrechaFigures:
    """Run all methods on all sets, with the same images, camera, verification and mapper.

    Methods that differ only after mapping (`default` and whichever of `reloc` and `learned` has its
    keypoints) share extraction and matching. The time of these stages counts for each of them.
    """
    methods = options.chosen_methods(METHODS)
    # All inputs are read before the first reconstruction, which takes minutes.
    sets = read_sets(options.root, options.chosen_sets())

    def rows() -> Iterator[StrechaRow]:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            for each in sets:
                folder = (options.out or Path(scratch)) / each.folder.name
                folder.mkdir(parents=True, exist_ok=True)
                for method in methods:
                    work = folder / _work_name(method)
                    if method == "rootsift":
                        row = _run_rootsift(each, work, options)
                    else:
                        row = _run_method(each, method, work, options)
                    if options.out is not None and work.name != method:
                        _keep_model(work, folder / f"{method}-sparse")
                    yield row

    def figures(measured: list[StrechaRow]) -> StrechaFigures:
        return {
            "benchmark": "strecha",
            "versions": package_versions(),
            "intrinsics": "known" if options.intrinsics == "known" else "refined from a guess",
            "seed": options.seed,
            "rows": measured,
            "ratios": ratios(measured),
            "published": PUBLISHED,
        }

    return collect(rows(), figures, line=row_line, json_file=options.json)


def _keep_model(work: Path, to: Path) -> None:
    """Copy a model out of a work folder that several methods share."""
    shutil.rmtree(to, ignore_errors=True)
    if (work / "sparse").is_dir():
        shutil.copytree(work / "sparse", to)


def ratios(rows: Sequence[StrechaRow]) -> dict[str, MethodRatios]:
    """Each method's figures divided by the baseline's, by set and as the mean of the sets."""
    base = {row["set"]: row for row in rows if row["method"] == BASELINE and "position" in row}
    result: dict[str, MethodRatios] = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        per_set = {
            row["set"]: _ratios_of(row, base[row["set"]])
            for row in rows
            if row["method"] == method != BASELINE and "position" in row and row["set"] in base
        }
        if per_set:
            keys = next(iter(per_set.values()))
            mean = {k: float(np.mean([v[k] for v in per_set.values()])) for k in keys}
            result[method] = {"sets": per_set, "mean": mean}
    return result


def _ratios_of(row: StrechaRow, base: StrechaRow) -> dict[str, float]:
    def figures(of: StrechaRow) -> dict[str, float]:
        assert "position" in of and "rotation_deg" in of
        assert "points" in of and "reprojection_error_px" in of
        return {
            "position": of["position"]["mean"],
            "rotation": of["rotation_deg"]["mean"],
            "points": of["points"],
            "reprojection_error": of["reprojection_error_px"],
        }

    below = figures(base)
    return {name: value / below[name] for name, value in figures(row).items()}


HEADER = (
    f"{'set':16s} {'method':9s} {'images':>7s} {'position':>9s} {'rotation':>9s} {'points':>7s} "
    f"{'observ.':>8s} {'track':>6s} {'reproj.':>8s} {'focal':>7s} {'seconds':>8s}"
)


def row_line(row: StrechaRow) -> str:
    """One line of the table."""
    head = f"{row['set']:16s} {row['method']:9s} {row['registered']:3d}/{row['images']:<3d}"
    if "position" not in row:
        return f"{head}   {row.get('not_evaluated', 'no model')}"
    assert "rotation_deg" in row and "focal_error_percent" in row
    assert "points" in row and "observations" in row
    assert "track_length" in row and "reprojection_error_px" in row
    return (
        f"{head} {row['position']['mean']:9.4f} {row['rotation_deg']['mean']:9.4f} "
        f"{row['points']:7d} {row['observations']:8d} {row['track_length']:6.2f} "
        f"{row['reprojection_error_px']:8.3f} {row['focal_error_percent']:6.2f}% "
        f"{row['seconds']:8.1f}"
    )


def table_lines(result: StrechaFigures) -> list[str]:
    """The paper's table: mean errors in units of the reference and in degrees."""
    lines = [HEADER, *(row_line(row) for row in result["rows"]), ""]
    for method, figures in result["ratios"].items():
        mean = figures["mean"]
        lines.append(
            f"{method} / rootsift, mean of {len(figures['sets'])} sets: "
            f"position {mean['position']:.2f}, rotation {mean['rotation']:.2f}, "
            f"points {mean['points']:.2f}, reprojection error {mean['reprojection_error']:.2f}"
        )
    return [*lines, result["published"]]
