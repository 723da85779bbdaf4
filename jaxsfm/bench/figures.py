"""Figures that a benchmark measures: spreads over seeds, tables, JSON, and the most memory held."""

import contextlib
import dataclasses
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Generic, TypedDict, TypeVar

import numpy as np

from jaxsfm.bench.options import BenchOptions
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.libraries import package_versions

Row = TypeVar("Row")
Summary = TypeVar("Summary")
Cells = dict[str, str]
"""One row of a table as text, by the heads of its columns."""
_STATUS, _FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class BenchFigures(TypedDict, Generic[Row, Summary]):
    """The figures of a benchmark, as JSON."""

    benchmark: str
    versions: dict[str, str]
    options: dict[str, object]
    """The options of the command; paths are text."""
    rows: list[Row]
    summary: Summary
    """Figures over all rows."""


class Spread(TypedDict):
    """A figure over several seeds."""

    mean: float
    min: float
    max: float


def spread(values: Iterable[float]) -> Spread:
    """Mean, smallest and largest of the values."""
    array = np.asarray(list(values), np.float64)
    return {"mean": float(array.mean()), "min": float(array.min()), "max": float(array.max())}


def collect(
    benchmark: str,
    rows: Iterable[Row],
    summary: Callable[[list[Row]], Summary],
    cells: Callable[[Row], Cells],
    options: BenchOptions,
) -> BenchFigures[Row, Summary]:
    """Measure all rows and return their figures.

    Each row is printed as soon as it is measured, and the JSON file is written anew with all rows
    so far, because a benchmark may run for hours and be interrupted.

    Args:
      benchmark: the name of the benchmark.
      rows: measures one row after the other.
      summary: the figures over all rows.
      cells: a row as text.
      options: the options of the command.
    """
    figures: BenchFigures[Row, Summary] = {
        "benchmark": benchmark,
        "versions": package_versions(),
        "options": json.loads(json.dumps(dataclasses.asdict(options), default=str)),
        "rows": [],
        "summary": summary([]),
    }
    for row in rows:
        figures["rows"].append(row)
        figures["summary"] = summary(figures["rows"])
        print(", ".join(f"{head} {text}" for head, text in cells(row).items()), flush=True)
        if options.json is not None:
            write_json(options.json, figures)
    return figures


def table(rows: Sequence[Cells], *, names: int = 2) -> list[str]:
    """Rows as lines of text with a line of heads; text that a row does not have stays blank.

    The first `names` columns are aligned to the left.
    """
    heads = list(dict.fromkeys(head for row in rows for head in row))
    lines = [heads, *([row.get(head, "") for head in heads] for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(heads))]
    return [
        "  ".join(
            text.ljust(width) if k < names else text.rjust(width)
            for k, (text, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]


def write_json(path: Path, figures: Mapping[str, object]) -> None:
    """Write figures as JSON; the file appears whole or not at all."""
    write_atomic(path, json.dumps(figures, indent=1, allow_nan=False).encode())


def forget_peak() -> None:
    """Count the most memory from now on; without effect on other systems."""
    with contextlib.suppress(OSError):
        _FORGET.write_text("5", encoding="ascii")  # proc(5): resets VmHWM


def peak_bytes() -> int | None:
    """The largest resident set since `forget_peak`, bytes; None where the system does not say."""
    with contextlib.suppress(OSError):
        found = re.search(r"^VmHWM:\s*(\d+) kB", _STATUS.read_text(encoding="ascii"), re.MULTILINE)
        return int(found[1]) * 1024 if found else None
    return None
