"""`bench daynight`: the paper's night protocol (section 4.1).

Each subset holds day photos and one night photo. It is reconstructed, the day cameras alone fix the
similarity to the reference, and the night camera is judged: registered or not, and how far away.
"""

import functools
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsfm.bench import scenes
from jaxsfm.bench.common import RUN_ABLATED, Keep, method_config
from jaxsfm.bench.night_matches import NightMatches, night_matches
from jaxsfm.bench.scenes import Scene, Subset
from jaxsfm.colmap.database import VerificationOptions, drop_pairs
from jaxsfm.colmap.mapper import MapOptions, build_models
from jaxsfm.colmap.poses import Poses, model_poses
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import read_two_views
from jaxsfm.errors import UserError
from jaxsfm.io.features import ImageFeatures, image_capacity
from jaxsfm.io.pairs import Pair, PairResult, exhaustive_pairs
from jaxsfm.io.versions import package_versions
from jaxsfm.io.weights import chosen_weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.matching.pair_matching import match_pairs
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice
from jaxsfm.sfm.evaluation import evaluate
from jaxsfm.sfm.reconstruction import reconstruct

METHODS = ("rootsift", "paper-grid", "paper", "default", "robust", "paper-learned", *RUN_ABLATED)
"""paper-grid: the preset `paper` at cell centres. (The paper's own row without relocalization has
corners of cells and 80 px.)"""
FEATURES = 64
"""Photos whose features are held, or as many as a subset has: 50 MB each at 1536 x 1024."""
LIMITS = ((0.1, 1.0), (0.5, 10.0), (1.0, 10.0), (5.0, 10.0), (10.0, 10.0), (20.0, 10.0))
"""Distance (the reference's units; metres for Strecha and Aachen) and degrees."""
PUBLISHED = (
    "published (Widya et al. 2018, Aachen, 98 subsets of 20 day + 1 night): registered night / day "
    "DoG + RootSIFT 48 / 1910, dense without relocalization 95 / 1924, with 96 / 1944"
)


class Made(NamedTuple):
    """What a method made of one subset."""

    poses: Poses
    """Of the best model."""
    matches: NightMatches | None


def _rootsift_models(scene: Scene, scratch: Path, seed: int, threads: int) -> list[Made]:
    """Per subset: features and matches of all photos once, then what a subset has of them."""
    database = scratch / "all.db"
    images = [scene.images[name] for name in sorted(scene.images)]
    blanks = any(" " in name for name in scene.images)  # COLMAP's pair lists cannot hold them
    pairs = {p for subset in scene.subsets for p in exhaustive_pairs([*subset.day, subset.night])}
    write_rootsift_database(
        database,
        scene.folder,
        images,
        scene.camera,
        VerificationOptions(seed=seed, threads=threads),
        pairs=None if blanks else sorted(pairs),
    )
    every = read_two_views(database)
    options = MapOptions(refine_intrinsics=scene.camera is None, seed=seed, threads=threads)
    models = []
    for subset in scene.subsets:
        part = scratch / "part.db"
        shutil.copyfile(database, part)
        names = {*subset.day, subset.night}
        kept = {pair: view for pair, view in every.items() if names.issuperset(pair)}
        drop_pairs(part, every.keys() - kept.keys())
        found, _ = build_models(part, kept, options)
        poses = model_poses(found[0]) if found else {}
        models.append(Made(poses, night_matches(part, scene, subset)))
    return models


def _dense_models(
    scene: Scene,
    scratch: Path,
    method: str,
    seed: int,
    threads: int,
    network: WeightsChoice = USUAL_WEIGHTS,
) -> list[Made]:
    """Per subset; a photo's features and a pair's matches are computed once."""
    config = method_config(method)
    weights = chosen_weights(network, config.backbone)
    largest = max(len(subset.day) + 1 for subset in scene.subsets)

    @functools.lru_cache(maxsize=max(FEATURES, largest))
    def features(name: str) -> ImageFeatures:
        return image_features(weights, scene.images[name], config=config)

    capacities = {
        name: image_capacity(image, config=config) for name, image in scene.images.items()
    }
    last_use = {
        pair: k
        for k, subset in enumerate(scene.subsets)
        for pair in exhaustive_pairs([*subset.day, subset.night])
    }
    results: dict[Pair, PairResult] = {}
    options = MapOptions(refine_intrinsics=scene.camera is None, seed=seed, threads=threads)
    models = []
    for k, subset in enumerate(scene.subsets):
        pairs = exhaustive_pairs([*subset.day, subset.night])
        missing = [pair for pair in pairs if pair not in results]
        for result in match_pairs(features, capacities, missing, config=config, seed=seed):
            results[result.pair] = result
        made = reconstruct(
            [scene.images[name] for name in sorted({*subset.day, subset.night})],
            {pair: results[pair] for pair in pairs},
            scratch / "part.db",
            config=config,
            intrinsics=scene.camera,
            options=options,
        )
        poses = model_poses(made.models[0]) if made.models else {}
        models.append(Made(poses, night_matches(scratch / "part.db", scene, subset)))
        results = {pair: result for pair, result in results.items() if last_use[pair] > k}
    return models


def judge(made: Made, subset: Subset, truth: Poses) -> dict[str, Any]:
    """One subset's figures: day cameras registered, the night photo's matches, its camera's
    errors or why there are none."""
    poses = made.poses
    day = [name for name in subset.day if name in poses]
    row: dict[str, Any] = {
        "night": subset.night,
        "registered": subset.night in poses,
        "has_truth": subset.night in truth,
        "day_registered": len(day),
        "day_images": len(subset.day),
    }
    if made.matches is not None:
        row |= {"matches": made.matches.number, "correct": made.matches.correct}
    if not row["registered"] or subset.night not in truth:
        return row
    known = {name: truth[name] for name in (*subset.day, subset.night) if name in truth}
    try:
        errors = evaluate(poses, known, align_on=[name for name in day if name in known])
    except UserError as error:  # too few day cameras, or on one line
        return row | {"not_evaluated": str(error)}
    night = errors.images[subset.night]
    return row | {"position": night.position, "rotation_deg": night.rotation_deg}


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Registered nights and days, share of the nights within each limit, the cumulative curve, the
    nights' verified matches and how many of them are correct.

    The share is of all nights with a reference pose, registered or not; None without any.
    """
    judged = [row for row in rows if "position" in row]
    counted = [row for row in rows if "correct" in row]
    known = sum(row["has_truth"] for row in rows)
    return {
        "nights": len(rows),
        "night_registered": sum(row["registered"] for row in rows),
        "day_images": sum(row["day_images"] for row in rows),
        "day_registered": sum(row["day_registered"] for row in rows),
        "matches": sum(row["matches"] for row in counted) if counted else None,
        "correct": sum(row["correct"] for row in counted) if counted else None,
        "within": {
            f"{d:g}; {deg:g} deg": sum(
                row["position"] <= d and row["rotation_deg"] <= deg for row in judged
            )
            / known
            for d, deg in LIMITS
        }
        if known
        else None,
        "not_evaluated": sum("not_evaluated" in row for row in rows),
        "sorted_positions": sorted(row["position"] for row in judged),
        "median_rotation_deg": float(np.median([row["rotation_deg"] for row in judged]))
        if judged
        else None,
    }


def bench_daynight(
    root: Path,
    *,
    sets: Sequence[str] | None = None,
    methods: Sequence[str] = METHODS[:5],
    severity: float = 2.0,
    denoise: bool = True,
    jpeg: bool = True,
    seed: int = 0,
    threads: int = -1,
    network: WeightsChoice = USUAL_WEIGHTS,
    progress: bool = False,
    keep: Keep = lambda _: None,
) -> dict[str, Any]:
    """All methods on all subsets of all scenes; plain JSON.

    Args:
      root: see `jaxsfm.bench.scenes`.
      severity, denoise, jpeg: of the synthetic night, for Strecha sets.
      network: the files of its parameters.
    """
    scenes.check_severity(severity)
    folders = scenes.find_scenes(root, sets)
    ready: dict[str, Scene] = {}
    for name, folder in folders.items():  # all inputs are read before the first long run
        if scenes.is_strecha(folder):
            scenes.check_strecha(folder)
        elif (folder / scenes.AACHEN_PAIRS).is_file():
            ready[name] = scenes.aachen_scene(folder)
        else:
            ready[name] = scenes.simple_scene(folder)
    rows: list[dict[str, Any]] = []
    setting = {"seed": seed, "denoise": denoise, "jpeg": jpeg}
    for name, folder in folders.items():
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
            scratch = Path(temporary)
            scene = ready.get(name) or scenes.synthetic_scene(
                folder, scratch / "photos", severity=severity, **setting
            )
            for method in methods:
                start = time.monotonic()
                if method == "rootsift":
                    models = _rootsift_models(scene, scratch, seed, threads)
                else:
                    models = _dense_models(scene, scratch, method, seed, threads, network)
                subsets = [
                    judge(each, subset, scene.truth)
                    for each, subset in zip(models, scene.subsets, strict=True)
                ]
                rows.append(
                    {
                        "scene": name,
                        "synthetic": scene.synthetic,
                        "severity": severity if scene.synthetic else None,
                        "method": method,
                        "seconds": time.monotonic() - start,
                        "subsets": subsets,
                        **summary(subsets),
                    }
                )
                if progress:
                    print(row_line(rows[-1]), flush=True)
                keep(_result(rows, setting))
    return _result(rows, setting)


def _result(rows: list[dict[str, Any]], setting: dict[str, Any]) -> dict[str, Any]:
    totals = {
        method: summary([s for row in rows if row["method"] == method for s in row["subsets"]])
        for method in dict.fromkeys(row["method"] for row in rows)
    }
    return {
        "benchmark": "daynight",
        "versions": package_versions(),
        **setting,
        "rows": rows,
        "totals": totals,
        "published": PUBLISHED,
    }


HEADER = (
    f"{'scene':24s} {'method':9s} {'night':>7s} {'day':>9s} "
    + " ".join(f"{f'{d:g}; {deg:g}':>8s}" for d, deg in LIMITS)
    + f" {'correct':>9s} {'matches':>9s} {'seconds':>8s}"
)


def _figures(row: dict[str, Any]) -> str:
    shares = row["within"].values() if row["within"] else [None] * len(LIMITS)
    within = " ".join(f"{'-':>8s}" if share is None else f"{share:8.0%}" for share in shares)
    counts = ("-" if row[key] is None else str(row[key]) for key in ("correct", "matches"))
    return (
        f"{row['night_registered']:3d}/{row['nights']:<3d} "
        f"{row['day_registered']:4d}/{row['day_images']:<4d} {within} "
        + " ".join(f"{count:>9s}" for count in counts)
    )


def row_line(row: dict[str, Any]) -> str:
    """One line of the table."""
    kind = f" synthetic {row['severity']:g}" if row["synthetic"] else ""
    return f"{row['scene'] + kind:24s} {row['method']:9s} {_figures(row)} {row['seconds']:8.1f}"


def table_lines(result: dict[str, Any]) -> list[str]:
    """Nights and days registered, share of the nights within (distance; deg), correct ones of the
    nights' matches."""
    lines = [HEADER, *(row_line(row) for row in result["rows"])]
    lines += [f"{'all':24s} {m:9s} {_figures(row)}" for m, row in result["totals"].items()]
    for row in result["rows"]:
        if row["not_evaluated"]:
            why = next(s["not_evaluated"] for s in row["subsets"] if "not_evaluated" in s)
            lines.append(
                f"{row['scene']} {row['method']}: {row['not_evaluated']} nights registered but not "
                f"evaluated, e.g. {why}"
            )
    return [*lines, result["published"]]
