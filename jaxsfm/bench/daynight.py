"""`bench daynight`: the paper's night protocol (section 4.1).

Each subset holds day photos and one night photo. It is reconstructed, and the model is aligned with
the reference by a similarity from the day cameras alone. Then the night camera is judged: whether
it is registered, and how far it is from its reference pose.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NotRequired, TypedDict

from jaxsfm.bench import scenes
from jaxsfm.bench.curves import write_curves
from jaxsfm.bench.figures import BenchFigures, Cells, collect, table
from jaxsfm.bench.methods import RUN_METHODS
from jaxsfm.bench.options import DayNightOptions
from jaxsfm.bench.scenes import Scene, Subset
from jaxsfm.bench.subset_models import SubsetModel, dense_models, rootsift_models
from jaxsfm.colmap.poses import Poses
from jaxsfm.errors import UserError
from jaxsfm.sfm.evaluation import evaluate

LIMITS = ((0.1, 1.0), (0.5, 10.0), (1.0, 10.0), (5.0, 10.0), (10.0, 10.0), (20.0, 10.0))
"""Limits of the position error (units of the reference, metres for Strecha and Aachen) and of the
rotation error (degrees)."""
PUBLISHED = {
    "DoG + RootSIFT": (48, 1910, (15.31, 25.61, 36.73, 35.71, 39.80)),
    "dense, no relocalization": (95, 1924, (5.10, 14.29, 45.92, 61.22, 69.39)),
    "dense + relocalization": (96, 1944, (18.37, 33.67, 69.39, 81.63, 82.65)),
}
"""What the paper reports (Widya et al. 2018, table 2) for 98 subsets of Aachen, each of 20 day
photos and a night photo: registered night photos, registered day photos, and the percentages of the
night photos within 0.5, 1, 5, 10 and 20 m and 10 degrees."""


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
    nights_with_reference: int
    """The number of nights that `within` counts, registered or not."""
    within: dict[str, float] | None
    not_evaluated: int
    sorted_positions: list[float]
    """The position errors of the nights that were evaluated, units of the reference."""
    sorted_rotations_deg: list[float]


class DayNightRow(Summary):
    """The figures of one scene and one method."""

    scene: str
    synthetic: bool
    severity: float | None
    method: str
    seconds: float
    subsets: list[SubsetRow]


Totals = dict[str, Summary]
"""The figures of all scenes, by method."""


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


def limit_name(position: float, rotation_deg: float) -> str:
    """The name of a limit in tables and figures."""
    return f"{position:g}; {rotation_deg:g} deg"


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
        limit_name(d, deg): sum(p <= d and r <= deg for p, r in judged) / known
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
        "nights_with_reference": known,
        "within": within or None,
        "not_evaluated": sum("not_evaluated" in row for row in rows),
        "sorted_positions": sorted(position for position, _ in judged),
        "sorted_rotations_deg": sorted(rotation for _, rotation in judged),
    }


def bench_daynight(options: DayNightOptions) -> BenchFigures[DayNightRow, Totals]:
    """Run all methods on all subsets of all scenes (`jaxsfm.bench.scenes`)."""
    methods = options.chosen_methods(RUN_METHODS)
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

    figures = collect("daynight", rows(), totals, cells, options)
    if options.curves is not None:
        whole = {m: of for m, of in figures["summary"].items() if of["nights_with_reference"]}
        write_curves(
            options.curves,
            {
                "position error, units of the reference": {
                    method: of["sorted_positions"] for method, of in whole.items()
                },
                "rotation error, degrees": {
                    method: of["sorted_rotations_deg"] for method, of in whole.items()
                },
            },
            {method: of["nights_with_reference"] for method, of in whole.items()},
        )
    return figures


def totals(rows: Sequence[DayNightRow]) -> Totals:
    """The figures of all scenes together, by method."""
    return {
        method: summary([s for row in rows if row["method"] == method for s in row["subsets"]])
        for method in dict.fromkeys(row["method"] for row in rows)
    }


def _row(
    name: str, scene: Scene, method: str, scratch: Path, options: DayNightOptions
) -> DayNightRow:
    start = time.monotonic()
    if method == "rootsift":
        models = rootsift_models(scene, scratch, options)
    else:
        models = dense_models(scene, scratch, method, options)
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


def _figures(row: Summary) -> Cells:
    found = {
        "night": f"{row['night_registered']}/{row['nights']}",
        "day": f"{row['day_registered']}/{row['day_images']}",
        **{limit: f"{share:.0%}" for limit, share in (row["within"] or {}).items()},
    }
    if row["matches"] is not None:
        found |= {"correct": str(row["correct"]), "matches": str(row["matches"])}
    return found


def cells(row: DayNightRow) -> Cells:
    """A row of the table: registered nights and days, shares of nights within limits, matches."""
    kind = f" synthetic {row['severity']:g}" if row["synthetic"] else ""
    return {
        "scene": row["scene"] + kind,
        "method": row["method"],
        **_figures(row),
        "seconds": f"{row['seconds']:.1f}",
    }


def table_lines(result: BenchFigures[DayNightRow, Totals]) -> list[str]:
    """The table of all scenes, with the totals and the paper's own rows."""
    whole = [
        {"scene": "all", "method": method, **_figures(row)}
        for method, row in result["summary"].items()
    ]
    published = [
        {
            "scene": "published, Aachen",
            "method": method,
            "night": f"{night}/98",
            "day": f"{day}/1960",
            **{
                limit_name(*limit): f"{percent:.0f}%"
                for limit, percent in zip(LIMITS[1:], within, strict=True)
            },
        }
        for method, (night, day, within) in PUBLISHED.items()
    ]
    lines = table([*map(cells, result["rows"]), *whole, *published])
    for row in result["rows"]:
        if row["not_evaluated"]:
            why = next(s["not_evaluated"] for s in row["subsets"] if "not_evaluated" in s)
            lines.append(
                f"{row['scene']} {row['method']}: {row['not_evaluated']} nights registered but not "
                f"evaluated, e.g. {why}"
            )
    return lines
