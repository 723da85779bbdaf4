"""`bench daynight`: the paper's night protocol (section 4.1).

Each subset holds day photos and one night photo. It is reconstructed, and the model is aligned with
the reference by a similarity from the day cameras alone. Then the night camera is judged: whether
it is registered, and how far it is from its reference pose.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from jaxsfm.bench import scenes
from jaxsfm.bench.aachen import PAIRS, aachen_scene, write_submission
from jaxsfm.bench.figures import BenchFigures, Cells, collect, table
from jaxsfm.bench.methods import METHODS, NAIVE
from jaxsfm.bench.model_options import DayNightOptions
from jaxsfm.bench.night_protocol import LIMITS, SubsetRow, Summary, judge, limit_name, summary
from jaxsfm.bench.scenes import Scene
from jaxsfm.bench.subset_models import dense_models, naive_models, rootsift_models
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.extras import require
from jaxsfm.report.plane_colours import COLOURS

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
    if options.curves is not None:
        require("plots", "--curves needs")
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


def cumulative(errors: Sequence[float], number: int) -> tuple[np.ndarray, np.ndarray]:
    """The cumulative curve of errors as the corners of a step function.

    Args:
      errors: the errors that are known, (n,).
      number: how many things there are, at least n. Those without an error are never reached.

    Returns:
      x (n + 1,): 0, then the errors in ascending order. y (n + 1,): the share of things whose error
      is at most x.
    """
    if number < max(len(errors), 1):
        raise ValueError(f"number must be at least {max(len(errors), 1)}; got {number}")
    share = np.arange(len(errors) + 1) / number
    return np.concatenate([[0.0], np.sort(np.asarray(errors, np.float64))]), share


def _write_curves(path: Path, whole: Totals) -> None:
    """Write the cumulative curves of the errors of night photos, as in figure 4 of the paper.

    The PNG file has a panel for each kind of error.
    """
    from matplotlib.figure import Figure

    from jaxsfm.report.plot import encode_figure

    judged = {method: of for method, of in whole.items() if of["nights_with_reference"]}
    if not judged:
        print(f"--curves {path}: not written, because no night photo has a reference pose")
        return
    positions = {method: of["sorted_positions"] for method, of in judged.items()}
    rotations = {method: of["sorted_rotations_deg"] for method, of in judged.items()}
    panels = {
        "position error, units of the reference": positions,
        "rotation error, degrees": rotations,
    }
    figure = Figure(figsize=(6 * len(panels), 4.5), dpi=120, layout="constrained")
    for k, (label, methods) in enumerate(panels.items(), start=1):
        axes = figure.add_subplot(1, len(panels), k)
        known = [error for errors in methods.values() for error in errors if error > 0]
        least, largest = (min(known) / 2, max(known) * 2) if known else (0.1, 10.0)
        for (method, errors), colour in zip(methods.items(), COLOURS * len(methods), strict=False):
            x, y = cumulative(errors, judged[method]["nights_with_reference"])
            axes.step([*x, largest], [*y, y[-1]], where="post", color=colour, label=method)
        axes.set_xscale("log")
        axes.set_xlim(least, largest)
        axes.set_ylim(0, 1.02)
        axes.set_xlabel(label)
        axes.set_ylabel("share of night photos")
        axes.grid(alpha=0.3)
    figure.axes[0].legend(loc="upper left")
    write_atomic(path, encode_figure(figure, ".png"))


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
