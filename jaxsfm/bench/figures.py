"""Figures that a benchmark measures: spreads over seeds, rows of a table, JSON."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypedDict, TypeVar

import numpy as np

from jaxsfm.io.atomic import write_atomic

Row = TypeVar("Row")
Figures = TypeVar("Figures", bound=Mapping[str, object])


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
    rows: Iterable[Row],
    figures: Callable[[list[Row]], Figures],
    *,
    line: Callable[[Row], str],
    json_file: Path | None,
) -> Figures:
    """Measure all rows and return their figures.

    Each row is printed as soon as it is measured, and the JSON file is written anew with all rows
    so far, because a benchmark may run for hours and be interrupted.

    Args:
      rows: measures one row after the other.
      figures: joins rows to what is written and returned.
      line: a row as one line of the table.
      json_file: where the figures are written; None writes none.
    """
    measured: list[Row] = []
    for row in rows:
        measured.append(row)
        print(line(row), flush=True)
        if json_file is not None:
            write_json(json_file, figures(measured))
    return figures(measured)


def write_json(path: Path, figures: Mapping[str, object]) -> None:
    """Write figures as JSON; the file appears whole or not at all."""
    write_atomic(path, json.dumps(figures, indent=1, allow_nan=False).encode())
