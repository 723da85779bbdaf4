"""`bench ambiguous`: are models of repeated structure right, and does a run say when they are not?

Rendered scenes (`jaxsfm.bench.repeated`) and sets in Strecha's layout are reconstructed at several
sizes, by our presets and by COLMAP's mappers. What counts as right is defined in
`jaxsfm.bench.judges`.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from jaxsfm.bench.figures import BenchFigures, Cells, collect, table
from jaxsfm.bench.inputs import StrechaSet, choose_sets, find_sets, read_set
from jaxsfm.bench.judges import OUTCOMES, Outcome, doubt, judge
from jaxsfm.bench.methods import AMBIGUOUS_METHODS, MAPPERS
from jaxsfm.bench.model_options import AmbiguousOptions
from jaxsfm.bench.repeated import SCENES, write_repeated
from jaxsfm.bench.strecha import ModelRow, camera_errors, not_evaluated_lines
from jaxsfm.bench.strecha_models import MethodRun, set_models, take_matches
from jaxsfm.colmap.poses import model_poses
from jaxsfm.errors import UserError, writing
from jaxsfm.sfm.check.common_places import extent, groups

SAME_MATCHES = ("default", *MAPPERS)
"""Methods that have the same matches, which are computed once."""
GROUPS_SHOWN = 4
"""The number of groups that the table shows; the JSON file has all of them."""


class Task(NamedTuple):
    """A set at one size, with one seed."""

    name: str
    size: int
    seed: int


class AmbiguousRow(ModelRow):
    """The figures of one task and one method."""

    size: int
    seed: int
    models: list[int]
    """The number of photos in each model, the largest first."""
    groups: list[list[int]]
    """For each model of three photos and more: the sizes of the groups it is made of."""
    alternative: list[int]
    """The sizes of the groups of the other model; empty if there is none."""
    outcome: Outcome
    doubt: str
    """What the run says against its model; empty if it says nothing."""
    extent: float
    """The largest distance of two reference cameras, units of the reference."""
    position_share: float | None
    """The mean position error divided by the extent."""


Counts = dict[str, dict[Outcome, int]]
"""How often each method had each outcome, by method."""


def _choose(options: AmbiguousOptions) -> dict[str, Path | None]:
    """The chosen sets by name; None stands for a synthetic scene.

    Raises:
      UserError: there are no sets in --root, or a name is unknown.
    """
    found = {} if options.root is None else {f.name: f for f in find_sets(options.root, None)}
    if taken := sorted(found.keys() & set(SCENES)):
        raise UserError(f"--root {options.root}: {taken[0]} is the name of a synthetic scene")
    places: dict[str, Path | None] = {**found, **dict.fromkeys(SCENES)}
    chosen = options.chosen_sets()
    names = list(places) if chosen is None else chosen
    where = "the synthetic scenes" if options.root is None else f"{options.root} or synthetic"
    return {name: places[name] for name in choose_sets({n: n for n in places}, names, where)}


def _rendered(work: Path, task: Task) -> StrechaSet:
    """Draw a synthetic scene into `work`/scene."""
    folder = work / "scene"
    with writing(f"--out {folder}"):
        write_repeated(folder, task.name, task.seed, (task.size, task.size * 3 // 4))
    return read_set(folder)


def _measure(each: StrechaSet, task: Task, run: MethodRun, work: Path) -> AmbiguousRow:
    """Run a method on a task, in the folder `work`/METHOD."""
    if run.method in SAME_MATCHES:
        for other in SAME_MATCHES:
            take_matches(work / run.method, work / other)
    made = set_models(each, work / run.method, run)
    poses = [model_poses(model) for model in made.models]
    said = doubt(made.report)
    judgement = judge(poses, each.truth, noticed=bool(said))
    other = [] if made.alternative is None else groups(model_poses(made.alternative), each.truth)
    errors, wide = camera_errors(poses[0] if poses else None, each.truth), extent(each.truth)
    position = errors["position"]
    return {
        "set": task.name,
        "size": task.size,
        "seed": task.seed,
        "method": run.method,
        "images": len(each.truth),
        "models": [len(model) for model in poses],
        "groups": judgement.groups,
        "alternative": [len(group) for group in other],
        "outcome": judgement.outcome,
        "doubt": said,
        "extent": wide,
        "position_share": None if position is None else position["mean"] / wide,
        "stages": made.seconds,
        **errors,
    }


def bench_ambiguous(options: AmbiguousOptions) -> BenchFigures[AmbiguousRow, Counts]:
    """Run all methods on all sets, at all sizes, with all seeds."""
    methods = options.chosen_methods(AMBIGUOUS_METHODS)
    places = _choose(options)
    # All inputs are read before the first reconstruction, which takes minutes.
    given = {name: read_set(folder) for name, folder in places.items() if folder is not None}
    tasks = [
        Task(name, size, seed)
        for name in places
        for size in options.chosen_sizes()
        for seed in range(options.seeds)
    ]

    def rows() -> Iterator[AmbiguousRow]:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            for task in tasks:
                out = options.out or Path(scratch)
                work = out / task.name / str(task.size) / f"seed{task.seed}"
                each = given.get(task.name) or _rendered(work, task)
                for method in methods:
                    run = MethodRun(
                        method=method,
                        network=options.network,
                        seed=task.seed,
                        threads=options.threads,
                        max_size=task.size,
                    )
                    yield _measure(each, task, run, work)

    return collect("ambiguous", rows(), counts, cells, options)


def counts(rows: list[AmbiguousRow]) -> Counts:
    """How often each method had each outcome."""
    found: Counts = {}
    for row in rows:
        each = found.setdefault(row["method"], dict.fromkeys(OUTCOMES, 0))
        each[row["outcome"]] += 1
    return found


def _sizes(sizes: list[int]) -> str:
    """The sizes of groups as text, with no more than `GROUPS_SHOWN` of them."""
    return "+".join([*map(str, sizes[:GROUPS_SHOWN]), *["..."] * (len(sizes) > GROUPS_SHOWN)])


def cells(row: AmbiguousRow) -> Cells:
    """A row of the table: the groups of the best model and of the other, errors and the outcome."""
    found = {
        "set": row["set"],
        "method": row["method"],
        "size": str(row["size"]),
        "seed": str(row["seed"]),
        "images": f"{max(row['models'], default=0)}/{row['images']}",
        "models": str(len(row["models"])),
        "groups": _sizes(row["groups"][0]) if row["groups"] else "",
    }
    if row["alternative"]:
        found["other model"] = _sizes(row["alternative"])
    if row["position"] is not None and row["rotation_deg"] is not None:
        found["position"] = f"{row['position']['mean']:.4f}"
        found["rotation"] = f"{row['rotation_deg']['mean']:.3f}"
    if row["position_share"] is not None:
        found["of extent"] = f"{100 * row['position_share']:.2f}%"
    return found | {
        "seconds": f"{sum(row['stages'].values()):.1f}",
        "outcome": row["outcome"],
    }


def table_lines(result: BenchFigures[AmbiguousRow, Counts]) -> list[str]:
    """All rows, and how often each method had each outcome."""
    lines = table([cells(row) for row in result["rows"]])
    lines += not_evaluated_lines(result["rows"])
    summed: list[Cells] = [
        {"method": method, **{outcome: str(n) for outcome, n in each.items()}}
        for method, each in result["summary"].items()
    ]
    return [*lines, "", *table(summed, names=1)]
