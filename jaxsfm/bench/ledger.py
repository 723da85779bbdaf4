"""`bench ledger`: one table of ordinary, ambiguous and hard sets, of runs with plain defaults.

Each set is reconstructed with some seeds, in OUT/SET/seedN/run. Photos that were taken by a camera
are also reconstructed with RootSIFT and COLMAP's mapper, once, in OUT/SET/seed0/rootsift. A run
whose report is there is not made again; only its models are judged again.
"""

import dataclasses
import datetime
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jaxsfm
from jaxsfm.bench.figures import Cells, collect
from jaxsfm.bench.judges import doubt, judge
from jaxsfm.bench.ledger_runs import (
    NOTHING_AFTER,
    SECONDS,
    LedgerRun,
    apart,
    finished_run,
    kept_run,
    part_runs,
    run_rootsift,
    run_set,
)
from jaxsfm.bench.ledger_sets import LedgerSet, SetPhotos, choose_ledger_sets
from jaxsfm.bench.ledger_table import (
    LedgerFigures,
    LedgerRow,
    RootsiftFigures,
    cells,
    counts,
    markdown,
)
from jaxsfm.bench.model_options import LedgerOptions
from jaxsfm.bench.strecha import camera_errors
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import Poses, model_poses
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.pair_selection import FEW
from jaxsfm.io.photo_folder import find_images
from jaxsfm.io.typed_files import read_json
from jaxsfm.report.run_report import RunReport
from jaxsfm.runs.run_options import RunOptions, check_options


class _Errors(NamedTuple):
    """Mean errors of the cameras of a model; None without a model or a reference."""

    position: float | None = None
    rotation_deg: float | None = None


def _errors(each: LedgerSet, given: SetPhotos, models: list[Poses]) -> _Errors:
    """The errors of the first model."""
    if not (models and given.truth and each.positions):
        return _Errors()
    found = camera_errors(models[0], given.truth)
    position, rotation = found["position"], found["rotation_deg"]
    if position is None or rotation is None:
        return _Errors()
    return _Errors(position["mean"], rotation["mean"])


def _models(folder: Path) -> list[Poses]:
    """The poses of the models in a folder, in the order of their numbers."""
    found: list[Poses] = []
    while (path := folder / str(len(found))).is_dir():
        found.append(model_poses(read_model(path)))
    return found


def judged_row(
    each: LedgerSet, given: SetPhotos, seed: int, folder: Path, rootsift: RootsiftFigures | None
) -> LedgerRow:
    """The row of a run, from what it left in its folder.

    Args:
      given: the photos of the set.
      rootsift: the figures of RootSIFT's run on them.
    """
    names, report = find_images(given.photos), kept_run(folder)
    row: LedgerRow = {
        "set": each.name,
        "kind": each.kind,
        "half": each.half,
        "seed": seed,
        "without": "",
        "images": len(names),
        "registered": 0,
        "largest": 0,
        "models": [],
        "right": None if given.truth is None and each.judge != "ring" else 0,
        "position": None,
        "rotation_deg": None,
        "verdict": "",
        "outcome": "ended in an error",
        "doubt": "",
        "wrong": None,
        "error": "",
        "mappings": None,
        "seconds": {},
        "total_seconds": 0.0,
        "rootsift": rootsift,
        "times_rootsift": None,
    }
    if not isinstance(report, RunReport):
        return {**row, "error": report or "the run left no report"}
    at = finished_run(folder)
    try:
        models = _models(at / "sparse") if at else []
    except UserError as error:
        return {**row, "error": str(error)}
    said, errors = doubt(report), _errors(each, given, models)
    found = judge(models, given.truth, noticed=bool(said), how=each.judge, names=names)
    total = sum(report.seconds.values())
    times = total / sum(rootsift["seconds"].values()) if rootsift else None
    return {
        **row,
        "registered": len(set().union(*models)),
        "largest": len(models[0]) if models else 0,
        "models": [len(model) for model in models],
        "right": found.right,
        "position": errors.position,
        "rotation_deg": errors.rotation_deg,
        "verdict": report.verdict or "",
        "outcome": found.outcome,
        "doubt": said,
        "wrong": max((each.doubt for _, each in report.checked), default=None),
        "mappings": len(report.mapping),
        "seconds": dict(report.seconds),
        "total_seconds": total,
        "times_rootsift": times,
    }


def rootsift_figures(each: LedgerSet, given: SetPhotos, folder: Path) -> RootsiftFigures | None:
    """The figures of RootSIFT's run in a folder; None if it did not come to its end."""
    seconds = read_json(folder / SECONDS, dict[str, float])
    if seconds is None:
        return None
    models = _models(folder / "sparse")
    errors = _errors(each, given, models)
    return {
        "registered": len(set().union(*models)),
        "position": errors.position,
        "rotation_deg": errors.rotation_deg,
        "seconds": seconds,
    }


def _with_rootsift(each: LedgerSet, run: LedgerRun, home: Path, report: object) -> None:
    """Make RootSIFT's run unless it is there.

    Of many photos, it gets the pairs that a run of ours has tried, as the report says.
    """
    folder, pairs = home / "seed0" / "rootsift", None
    if not each.real or (folder / SECONDS).is_file():
        return
    if len(find_images(run.given.photos)) > FEW:
        if not isinstance(report, RunReport):
            return
        pairs = sorted(tried.pair for tried in report.pairs.each)
    if why := apart(run_rootsift, run, folder, pairs):
        print(f"{each.name}: RootSIFT has no figures: {why}", flush=True)


def _run_options(options: LedgerOptions, seed: int) -> RunOptions:
    """The options of a run that are not of the set."""
    return RunOptions(
        network=options.network,
        seed=seed,
        threads=options.threads,
        progress=True,
        without=options.without,
    )


def _set_rows(each: LedgerSet, out: Path, options: LedgerOptions) -> Iterator[LedgerRow]:
    """The rows of a set, one for each seed."""
    home, left_out = out / each.name, "+".join(options.without)
    if options.parts:
        yield from _part_rows(each, home, options)
        return
    end = f"-without-{left_out}" if left_out else ""
    folders = {seed: home / f"seed{seed}{end}" / "run" for seed in range(options.seeds)}
    if options.only_judge:
        folders = {seed: at for seed, at in folders.items() if kept_run(at) is not None}
    if not folders:
        return
    given = each.photos(home)
    for seed, folder in folders.items():
        if not options.only_judge:
            run = LedgerRun(given, _run_options(options, seed), each.max_size)
            report = run_set(run, folder)
            if seed == 0:
                _with_rootsift(each, run, home, report)
        rootsift = rootsift_figures(each, given, home / "seed0" / "rootsift")
        yield {**judged_row(each, given, seed, folder, rootsift), "without": left_out}


def _part_rows(each: LedgerSet, home: Path, options: LedgerOptions) -> Iterator[LedgerRow]:
    """The rows of parts of a set; their seeds are the numbers of the parts."""
    chosen = dataclasses.replace(_run_options(options, 0), without=NOTHING_AFTER, progress=False)
    run = LedgerRun(each.photos(home), chosen, each.max_size)
    count, whole = options.parts if each.real else 0, home / "seed0" / "run"
    for number, part, folder in part_runs(run, home / "parts", whole, count):
        yield {**judged_row(each, part, number, folder, None), "without": "parts"}


def bench_ledger(options: LedgerOptions) -> LedgerFigures:
    """Reconstruct the sets and judge the results; with `markdown`, also write the table.

    Raises:
      UserError: a set or an option cannot be used.
    """
    sets = choose_ledger_sets(options.root, options.chosen_sets())
    check_options(_run_options(options, 0))

    def rows() -> Iterator[LedgerRow]:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            for each in sets:
                yield from _set_rows(each, options.out or Path(scratch), options)

    def said(row: LedgerRow) -> Cells:
        return {head: text for head, text in cells(row).items() if text}

    figures = collect("ledger", rows(), counts, said, options)
    if options.markdown is not None:
        date = datetime.date.today().isoformat()
        write_atomic(options.markdown, markdown(figures, date, _commit()).encode())
    return figures


def _commit() -> str:
    """The commit of the software; empty if it does not run from a repository."""
    here = Path(jaxsfm.__file__).parent
    command = ["git", "rev-parse", "--short", "HEAD"]
    try:
        found = subprocess.run(command, cwd=here, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return found.stdout.strip()
