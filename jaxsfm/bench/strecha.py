"""`bench strecha`: the paper's comparison on standard scenes (Strecha et al., CVPR 2008)."""

import dataclasses
import json
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsfm.bench.common import (
    RUN_ABLATED,
    Keep,
    check_root,
    choose_sets,
    method_config,
    read_rows,
)
from jaxsfm.colmap.database import VerificationOptions
from jaxsfm.colmap.intrinsics import parse_intrinsics
from jaxsfm.colmap.mapper import MapOptions, build_models
from jaxsfm.colmap.models import write_models
from jaxsfm.colmap.poses import Poses, model_poses, read_model, read_poses
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import read_two_views
from jaxsfm.config import preset
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.versions import package_versions
from jaxsfm.matching.pipeline import open_images
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice
from jaxsfm.report.run_results import ModelRow
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.report import model_row
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.evaluation import evaluate

METHODS = ("rootsift", "grid", "reloc", "learned", "default", "robust", *RUN_ABLATED)
USUAL = ("rootsift", "grid", "reloc", "default")
PUBLISHED = (
    "published (Widya et al. 2018, mean over six full-size sets): "
    "DoG + RootSIFT 0.17 m, 0.90 deg; dense + relocalization 0.59 m, 2.27 deg"
)


def strecha_intrinsics(folder: Path) -> tuple[str, float]:
    """A set's camera as `MODEL:params`, and its focal length in pixels.

    The sets' K counts pixels from the image's corner, as COLMAP does: it was halved with the
    images, which is exact only there, and rotations agree better that way (docs/results.md).
    """
    path = folder / "images" / "K.txt"
    k = read_rows(path, 3, "a camera matrix (3 x 3)")
    if k.shape != (3, 3) or k[0, 0] <= 0 or k[1, 1] <= 0:
        raise UserError(f"--root: {path} is not a camera matrix")
    fx, fy, cx, cy = (float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    return f"PINHOLE:{fx!r},{fy!r},{cx!r},{cy!r}", 0.5 * (fx + fy)


def find_sets(root: Path, names: Sequence[str] | None) -> list[Path]:
    """Strecha folders (images/K.txt inside) below `root`, by name.

    Raises:
      UserError: none there, or one of `names` is not.
    """
    check_root(root)
    found = {path.parent.parent.name: path.parent.parent for path in root.glob("*/images/K.txt")}
    if not found:
        raise UserError(f"--root {root}: no Strecha sets (SET/images/K.txt) in it")
    return choose_sets(found, names, root)


def _row(set_name: str, method: str, model: ModelRow | None) -> dict[str, Any]:
    row: dict[str, Any] = {"set": set_name, "method": method, "registered": 0}
    if model is not None:
        plain = to_json(dataclasses.replace(model, images=[]))
        assert isinstance(plain, dict)
        row |= {key: value for key, value in plain.items() if key != "images"}
    return row


def _finish(row: dict[str, Any], model_folder: Path, truth: Poses, focal: float) -> dict[str, Any]:
    """Errors of a row's model against the ground truth, and of its focal lengths."""
    row["images"] = len(truth)
    if not (model_folder / "images.bin").is_file():
        return row
    model = read_model(model_folder)
    try:
        errors = evaluate(model_poses(model), truth)
    except UserError as error:
        row["not_evaluated"] = str(error)
        return row
    row["position"], row["rotation_deg"] = errors.position, errors.rotation_deg
    focals = [
        model.cameras[model.image(i).camera_id].mean_focal_length() for i in model.reg_image_ids()
    ]
    row["focal_error_percent"] = 100 * float(np.max(np.abs(np.asarray(focals) / focal - 1)))
    return row


def run_rootsift(
    folder: Path, out: Path, intrinsics: str | None, *, seed: int, threads: int
) -> dict[str, Any]:
    """COLMAP with its own features on one set; the model goes to `out`/sparse."""
    out.mkdir(parents=True, exist_ok=True)
    images, _ = open_images(folder / "images")
    start = time.monotonic()
    given = parse_intrinsics(intrinsics) if intrinsics else None
    database = out / "database.db"
    verification = VerificationOptions(seed=seed, threads=threads)
    write_rootsift_database(database, folder / "images", images, given, verification)
    options = MapOptions(refine_intrinsics=intrinsics is None, seed=seed, threads=threads)
    models, _ = build_models(database, read_two_views(database), options)
    write_models(models, out / "sparse")
    row = _row(folder.name, "rootsift", model_row(models[0]) if models else None)
    return row | {"seconds": time.monotonic() - start}


def run_method(
    folder: Path,
    out: Path,
    method: str,
    intrinsics: str | None,
    *,
    seed: int,
    threads: int,
    progress: bool,
    network: WeightsChoice = USUAL_WEIGHTS,
) -> dict[str, Any]:
    """One of our methods on one set, in the work folder `out`."""
    options = RunOptions(
        intrinsics=intrinsics,
        network=network,
        seed=seed,
        threads=threads,
        progress=progress,
    )
    report = reconstruct_folder(
        folder / "images", out, config=method_config(method), options=options
    )
    row = _row(folder.name, method, report.models[0] if report.models else None)
    return row | {"stages": report.seconds, "seconds": sum(report.seconds.values())}


def _matching_seconds(work: Path, stages: dict[str, float]) -> dict[str, float]:
    """Seconds of extraction and matching in a work folder, also where they were done before.

    What is reused took its time once: the longest measured so far counts, and is kept beside it.
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
    """Methods that differ after mapping only share a work folder: the default preset's matches."""
    if method == "rootsift":
        return method
    config = method_config(method)
    usual = dataclasses.replace(preset("default"), keypoints=config.keypoints)
    return f"dense-{config.keypoints}" if config.matching() == usual.matching() else method


def bench_strecha(
    root: Path,
    *,
    sets: Sequence[str] | None = None,
    methods: Sequence[str] = USUAL,
    known_intrinsics: bool = True,
    out: Path | None = None,
    seed: int = 0,
    threads: int = -1,
    network: WeightsChoice = USUAL_WEIGHTS,
    progress: bool = False,
    keep: Keep = lambda _: None,
) -> dict[str, Any]:
    """All methods on all sets, same images, camera, verification and mapper; plain JSON.

    Methods that differ after mapping only (`default` and whichever of `reloc` and `learned` has its
    keypoints) share extraction and matching, which count in the seconds of each.

    Args:
      root: folder of Strecha sets (SET/images/K.txt, SET/gt_dense_cameras/*.camera).
      known_intrinsics: False: focal lengths are guessed and refined, one camera per image.
      out: keeps the work folders here, the models of methods that share one beside them; runs in
        it are gone on with.
      network: the files of its parameters.
    """
    folders = find_sets(root, sets)
    # All inputs are read before the first long run.
    cameras = {folder: strecha_intrinsics(folder) for folder in folders}
    truths = {folder: read_poses(folder, option="--root") for folder in folders}
    rows = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        for folder in folders:
            camera, focal = cameras[folder]
            given = camera if known_intrinsics else None
            for method in methods:
                work = (out or Path(scratch)) / folder.name
                work = work / _work_name(method)
                work.parent.mkdir(parents=True, exist_ok=True)
                if method == "rootsift":
                    row = run_rootsift(folder, work, given, seed=seed, threads=threads)
                else:
                    row = run_method(
                        folder,
                        work,
                        method,
                        given,
                        seed=seed,
                        threads=threads,
                        progress=progress,
                        network=network,
                    )
                if "stages" in row:
                    row["stages"] |= _matching_seconds(work, row["stages"])
                    row["seconds"] = sum(row["stages"].values())
                rows.append(_finish(row, work / "sparse" / "0", truths[folder], focal))
                if out is not None and work.name != method:
                    kept = work.parent / f"{method}-sparse"
                    shutil.rmtree(kept, ignore_errors=True)
                    if (work / "sparse").is_dir():
                        shutil.copytree(work / "sparse", kept)
                if progress:
                    print(row_line(rows[-1]), flush=True)
                keep(_result(rows, known_intrinsics, seed))
    return _result(rows, known_intrinsics, seed)


def _result(rows: list[dict[str, Any]], known_intrinsics: bool, seed: int) -> dict[str, Any]:
    return {
        "benchmark": "strecha",
        "versions": package_versions(),
        "intrinsics": "known" if known_intrinsics else "refined from a guess",
        "seed": seed,
        "rows": rows,
        "ratios": ratios(rows),
        "published": PUBLISHED,
    }


def ratios(rows: Sequence[dict[str, Any]], *, baseline: str = "rootsift") -> dict[str, Any]:
    """Every method's errors over the baseline's, per set and as the mean of the sets."""
    base = {row["set"]: row for row in rows if row["method"] == baseline and "position" in row}
    result: dict[str, Any] = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        if method == baseline:
            continue
        per_set = {
            row["set"]: {
                "position": row["position"]["mean"] / base[row["set"]]["position"]["mean"],
                "rotation": row["rotation_deg"]["mean"] / base[row["set"]]["rotation_deg"]["mean"],
                "points": row["points"] / base[row["set"]]["points"],
                "reprojection_error": row["reprojection_error_px"]
                / base[row["set"]]["reprojection_error_px"],
            }
            for row in rows
            if row["method"] == method and "position" in row and row["set"] in base
        }
        if per_set:
            keys = next(iter(per_set.values()))
            mean = {k: float(np.mean([v[k] for v in per_set.values()])) for k in keys}
            result[method] = {"sets": per_set, "mean": mean}
    return result


HEADER = (
    f"{'set':16s} {'method':9s} {'images':>7s} {'position':>9s} {'rotation':>9s} {'points':>7s} "
    f"{'observ.':>8s} {'track':>6s} {'reproj.':>8s} {'focal':>7s} {'seconds':>8s}"
)


def row_line(row: dict[str, Any]) -> str:
    """One line of the table."""
    head = f"{row['set']:16s} {row['method']:9s} {row['registered']:3d}/{row['images']:<3d}"
    if "position" not in row:
        return f"{head}   {row.get('not_evaluated', 'no model')}"
    return (
        f"{head} {row['position']['mean']:9.4f} {row['rotation_deg']['mean']:9.4f} "
        f"{row['points']:7d} {row['observations']:8d} {row['track_length']:6.2f} "
        f"{row['reprojection_error_px']:8.3f} {row['focal_error_percent']:6.2f}% "
        f"{row['seconds']:8.1f}"
    )


def table_lines(result: dict[str, Any]) -> list[str]:
    """The paper's table: mean errors in the reference's units and degrees."""
    lines = [HEADER, *(row_line(row) for row in result["rows"]), ""]
    for method, figures in result["ratios"].items():
        mean = figures["mean"]
        lines.append(
            f"{method} / rootsift, mean of {len(figures['sets'])} sets: "
            f"position {mean['position']:.2f}, rotation {mean['rotation']:.2f}, "
            f"points {mean['points']:.2f}, reprojection error {mean['reprojection_error']:.2f}"
        )
    return [*lines, result["published"]]
