"""`bench daynight`: the paper's night protocol (section 4.1).

Each subset holds day photos and one night photo. It is reconstructed, and the model is aligned with
the reference by a similarity from the day cameras alone. Then the night camera is judged: whether
it is registered, and how far it is from its reference pose.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from jaxsfm.bench import scenes
from jaxsfm.bench.aachen import PAIRS, aachen_scene, write_submission
from jaxsfm.bench.curves import write_curves
from jaxsfm.bench.figures import BenchFigures, Cells, collect, table
from jaxsfm.bench.methods import METHODS, NAIVE
from jaxsfm.bench.night_protocol import LIMITS, SubsetRow, Summary, judge, limit_name, summary
from jaxsfm.bench.options import DayNightOptions
from jaxsfm.bench.scenes import Scene
from jaxsfm.bench.subset_models import dense_models, naive_models, rootsift_models
from jaxsfm.errors import UserError

PUBLISHED = {
    "DoG + RootSIFT": (48, 1910, (15.31, 25.61, 36.73, 35.71, 39.80)),
    "dense, no relocalization": (95, 1924, (5.10, 14.29, 45.92, 61.22, 69.39)),
    "dense + relocalization": (96, 1944, (18.37, 33.67, 69.39, 81.63, 82.65)),
}
"""What the paper reports (Widya et al. 2018, table 2) for 98 subsets of Aachen, each of 20 day
photos and a night photo: registered night photos, registered day photos, and the percentages of the
night photos within 0.5, 1, 5, 10 and 20 m and 10 degrees."""


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


def bench_daynight(options: DayNightOptions) -> BenchFigures[DayNightRow, Totals]:
    """Run all methods on all subsets of all scenes (`jaxsfm.bench.scenes`)."""
    methods = options.chosen_methods(METHODS)
    folders = scenes.find_scenes(options.root, options.chosen_sets())
    aachen = (options.root / scenes.PHOTOS).is_dir()
    if not aachen and (options.subsets or options.poses):
        raise UserError("--subsets and --poses are for Aachen Day-Night only")
    if aachen and options.subsets is None:
        print(
            f"The subsets are those of {PAIRS}. The paper's own 98 subsets do not come with "
            "the data; --subsets takes a file of them."
        )
    ready: dict[str, Scene] = {}
    for name, folder in folders.items():  # all inputs are read before the first long run
        if aachen:
            ready[name] = aachen_scene(folder, options.subsets)
        elif scenes.is_strecha(folder):
            scenes.check_strecha(folder)
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
        _write_curves(options.curves, figures["summary"])
    if options.poses is not None:
        for row in figures["rows"]:
            poses = {s["night"]: s["pose"] for s in row["subsets"] if "pose" in s}
            print(write_submission(options.poses, row["method"], poses))
    return figures


def _write_curves(path: Path, whole: Totals) -> None:
    judged = {method: of for method, of in whole.items() if of["nights_with_reference"]}
    if not judged:
        print(f"--curves {path}: not written, because no night photo has a reference pose")
        return
    positions = {method: of["sorted_positions"] for method, of in judged.items()}
    rotations = {method: of["sorted_rotations_deg"] for method, of in judged.items()}
    write_curves(
        path,
        {
            "position error, units of the reference": positions,
            "rotation error, degrees": rotations,
        },
        {method: of["nights_with_reference"] for method, of in judged.items()},
    )


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
    elif method == NAIVE:
        models = naive_models(scene, scratch, options)
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
