"""`bench daynight`: the paper's night protocol (section 4.1).

Each subset holds day photos and one night photo. It is reconstructed, and the model is aligned with
the reference by a similarity from the day cameras alone. Then the night camera is judged: whether
it is registered, and how far it is from its reference pose.
"""

import functools
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, NotRequired, TypedDict

import numpy as np

from jaxsfm.bench import scenes
from jaxsfm.bench.figures import collect
from jaxsfm.bench.methods import RUN_ABLATED, method_config
from jaxsfm.bench.night_matches import NightMatches, night_matches
from jaxsfm.bench.options import DayNightOptions
from jaxsfm.bench.scenes import Scene, Subset
from jaxsfm.colmap.database import drop_pairs
from jaxsfm.colmap.mapper import MapOptions, build_models
from jaxsfm.colmap.poses import Poses, model_poses
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import read_two_views
from jaxsfm.colmap.verification import VerificationOptions
from jaxsfm.errors import UserError
from jaxsfm.io.features import ImageFeatures, image_capacity
from jaxsfm.io.pairs import Pair, PairResult, exhaustive_pairs
from jaxsfm.io.versions import package_versions
from jaxsfm.io.weights import chosen_weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.matching.pair_matching import match_pairs
from jaxsfm.sfm.evaluation import evaluate
from jaxsfm.sfm.reconstruction import reconstruct

METHODS = ("rootsift", "paper-grid", "paper", "default", "robust", "paper-learned", *RUN_ABLATED)
"""paper-grid is the preset `paper` with keypoints at cell centres. (The paper's own row without
relocalization has keypoints at the corners of cells and a threshold of 80 px.)"""
FEATURES = 64
"""Photos whose features are held (at least all photos of a subset): 50 MB each at 1536 x 1024."""
LIMITS = ((0.1, 1.0), (0.5, 10.0), (1.0, 10.0), (5.0, 10.0), (10.0, 10.0), (20.0, 10.0))
"""Limits of the position error (units of the reference, metres for Strecha and Aachen) and of the
rotation error (degrees)."""
PUBLISHED = (
    "published (Widya et al. 2018, Aachen, 98 subsets of 20 day + 1 night): registered night / day "
    "DoG + RootSIFT 48 / 1910, dense without relocalization 95 / 1924, with 96 / 1944"
)


class SubsetModel(NamedTuple):
    """A method's reconstruction of one subset."""

    poses: Poses
    """The poses of the largest model."""
    matches: NightMatches | None


class SubsetRow(TypedDict):
    """The figures of one subset."""

    night: str
    """The name of the night photo."""
    registered: bool
    has_truth: bool
    """Whether the night photo has a reference pose."""
    day_registered: int
    day_images: int
    matches: NotRequired[int]
    correct: NotRequired[int]
    not_evaluated: NotRequired[str]
    position: NotRequired[float]
    rotation_deg: NotRequired[float]


class Summary(TypedDict):
    """The figures of several subsets."""

    nights: int
    night_registered: int
    day_images: int
    day_registered: int
    matches: int | None
    correct: int | None
    within: dict[str, float] | None
    not_evaluated: int
    sorted_positions: list[float]
    median_rotation_deg: float | None


class DayNightRow(Summary):
    """The figures of one scene and one method."""

    scene: str
    synthetic: bool
    severity: float | None
    method: str
    seconds: float
    subsets: list[SubsetRow]


class DayNightFigures(TypedDict):
    """The figures of the benchmark, as JSON."""

    benchmark: str
    versions: dict[str, str]
    seed: int
    denoise: bool
    jpeg: bool
    rows: list[DayNightRow]
    totals: dict[str, Summary]
    published: str


def _map_options(scene: Scene, options: DayNightOptions) -> MapOptions:
    return MapOptions(
        refine_intrinsics=scene.camera is None, seed=options.seed, threads=options.threads
    )


def _rootsift_models(scene: Scene, scratch: Path, options: DayNightOptions) -> list[SubsetModel]:
    """A model of each subset from COLMAP's own features.

    Features and matches of all photos are computed once; each subset takes its part of them.
    """
    database = scratch / "all.db"
    images = [scene.images[name] for name in sorted(scene.images)]
    blanks = any(" " in name for name in scene.images)  # COLMAP's pair lists cannot hold them
    pairs = {p for subset in scene.subsets for p in exhaustive_pairs([*subset.day, subset.night])}
    write_rootsift_database(
        database,
        scene.folder,
        images,
        scene.camera,
        VerificationOptions(seed=options.seed, threads=options.threads),
        pairs=None if blanks else sorted(pairs),
    )
    every = read_two_views(database)
    models = []
    for subset in scene.subsets:
        part = scratch / "part.db"
        shutil.copyfile(database, part)
        names = {*subset.day, subset.night}
        kept = {pair: view for pair, view in every.items() if names.issuperset(pair)}
        drop_pairs(part, every.keys() - kept.keys())
        found, _ = build_models(part, kept, _map_options(scene, options))
        poses = model_poses(found[0]) if found else {}
        models.append(SubsetModel(poses, night_matches(part, scene, subset)))
    return models


def _dense_models(
    scene: Scene, scratch: Path, method: str, options: DayNightOptions
) -> list[SubsetModel]:
    """A model of each subset by one of our methods.

    A photo's features and a pair's matches are computed once for all subsets.
    """
    config = method_config(method)
    weights = chosen_weights(options.network, config.backbone)
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
    models = []
    for k, subset in enumerate(scene.subsets):
        pairs = exhaustive_pairs([*subset.day, subset.night])
        missing = [pair for pair in pairs if pair not in results]
        for result in match_pairs(features, capacities, missing, config=config, seed=options.seed):
            results[result.pair] = result
        made = reconstruct(
            [scene.images[name] for name in sorted({*subset.day, subset.night})],
            {pair: results[pair] for pair in pairs},
            scratch / "part.db",
            config=config,
            intrinsics=scene.camera,
            options=_map_options(scene, options),
        )
        poses = model_poses(made.models[0]) if made.models else {}
        models.append(SubsetModel(poses, night_matches(scratch / "part.db", scene, subset)))
        results = {pair: result for pair, result in results.items() if last_use[pair] > k}
    return models


def judge(made: SubsetModel, subset: Subset, truth: Poses) -> SubsetRow:
    """Count a subset's registered cameras and matches, and measure the night camera's errors."""
    poses = made.poses
    day = [name for name in subset.day if name in poses]
    row: SubsetRow = {
        "night": subset.night,
        "registered": subset.night in poses,
        "has_truth": subset.night in truth,
        "day_registered": len(day),
        "day_images": len(subset.day),
    }
    if made.matches is not None:
        row["matches"], row["correct"] = made.matches.number, made.matches.correct
    if not row["registered"] or subset.night not in truth:
        return row
    known = {name: truth[name] for name in (*subset.day, subset.night) if name in truth}
    try:
        errors = evaluate(poses, known, align_on=[name for name in day if name in known])
    except UserError as error:  # too few day cameras, or all on one line
        row["not_evaluated"] = str(error)
        return row
    night = errors.images[subset.night]
    row["position"], row["rotation_deg"] = night.position, night.rotation_deg
    return row


def summary(rows: Sequence[SubsetRow]) -> Summary:
    """The figures of several subsets together.

    The share of nights within a limit is that of all nights with a reference pose, registered or
    not. It is None if no night has a reference pose.
    """
    judged = [
        (row["position"], row["rotation_deg"])
        for row in rows
        if "position" in row and "rotation_deg" in row
    ]
    matches = [row["matches"] for row in rows if "matches" in row]
    correct = [row["correct"] for row in rows if "correct" in row]
    known = sum(row["has_truth"] for row in rows)
    within = {
        f"{d:g}; {deg:g} deg": sum(p <= d and r <= deg for p, r in judged) / known
        for d, deg in LIMITS
        if known
    }
    return {
        "nights": len(rows),
        "night_registered": sum(row["registered"] for row in rows),
        "day_images": sum(row["day_images"] for row in rows),
        "day_registered": sum(row["day_registered"] for row in rows),
        "matches": sum(matches) if matches else None,
        "correct": sum(correct) if correct else None,
        "within": within or None,
        "not_evaluated": sum("not_evaluated" in row for row in rows),
        "sorted_positions": sorted(position for position, _ in judged),
        "median_rotation_deg": float(np.median([r for _, r in judged])) if judged else None,
    }


def bench_daynight(options: DayNightOptions) -> DayNightFigures:
    """Run all methods on all subsets of all scenes (`jaxsfm.bench.scenes`)."""
    methods = options.chosen_methods(METHODS)
    folders = scenes.find_scenes(options.root, options.chosen_sets())
    ready: dict[str, Scene] = {}
    for name, folder in folders.items():  # all inputs are read before the first long run
        if scenes.is_strecha(folder):
            scenes.check_strecha(folder)
        elif (folder / scenes.AACHEN_PAIRS).is_file():
            ready[name] = scenes.aachen_scene(folder)
        else:
            ready[name] = scenes.simple_scene(folder)

    def rows() -> Iterator[DayNightRow]:
        for name, folder in folders.items():
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
                scratch = Path(temporary)
                scene = ready.get(name) or scenes.synthetic_scene(
                    folder, scratch / "photos", options
                )
                for method in methods:
                    yield _row(name, scene, method, scratch, options)

    def figures(measured: list[DayNightRow]) -> DayNightFigures:
        totals = {
            method: summary([s for r in measured if r["method"] == method for s in r["subsets"]])
            for method in dict.fromkeys(row["method"] for row in measured)
        }
        return {
            "benchmark": "daynight",
            "versions": package_versions(),
            "seed": options.seed,
            "denoise": options.denoise,
            "jpeg": options.jpeg,
            "rows": measured,
            "totals": totals,
            "published": PUBLISHED,
        }

    return collect(rows(), figures, line=row_line, json_file=options.json)


def _row(
    name: str, scene: Scene, method: str, scratch: Path, options: DayNightOptions
) -> DayNightRow:
    start = time.monotonic()
    if method == "rootsift":
        models = _rootsift_models(scene, scratch, options)
    else:
        models = _dense_models(scene, scratch, method, options)
    subsets = [
        judge(each, subset, scene.truth) for each, subset in zip(models, scene.subsets, strict=True)
    ]
    return {
        "scene": name,
        "synthetic": scene.synthetic,
        "severity": options.severity if scene.synthetic else None,
        "method": method,
        "seconds": time.monotonic() - start,
        "subsets": subsets,
        **summary(subsets),
    }


HEADER = (
    f"{'scene':24s} {'method':9s} {'night':>7s} {'day':>9s} "
    + " ".join(f"{f'{d:g}; {deg:g}':>8s}" for d, deg in LIMITS)
    + f" {'correct':>9s} {'matches':>9s} {'seconds':>8s}"
)


def _figures(row: Summary) -> str:
    shares = row["within"].values() if row["within"] else [None] * len(LIMITS)
    within = " ".join(f"{'-':>8s}" if share is None else f"{share:8.0%}" for share in shares)
    counts = ("-" if row[key] is None else str(row[key]) for key in ("correct", "matches"))
    return (
        f"{row['night_registered']:3d}/{row['nights']:<3d} "
        f"{row['day_registered']:4d}/{row['day_images']:<4d} {within} "
        + " ".join(f"{count:>9s}" for count in counts)
    )


def row_line(row: DayNightRow) -> str:
    """One line of the table."""
    kind = f" synthetic {row['severity']:g}" if row["synthetic"] else ""
    return f"{row['scene'] + kind:24s} {row['method']:9s} {_figures(row)} {row['seconds']:8.1f}"


def table_lines(result: DayNightFigures) -> list[str]:
    """The table: registered nights and days, shares of the nights within the limits, matches."""
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
