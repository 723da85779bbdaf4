"""`bench planes`: several homographies fitted to given points (AdelaideRMF, Wong et al. 2011).

Each point is labelled by hand as an outlier or as a point of one of the scene's planes. The figure
is the misclassification: the share of points with a wrong label when the planes that were found are
assigned to the true planes in the best way.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxsfm.bench.figures import BenchFigures, Cells, Spread, collect, spread, table
from jaxsfm.bench.inputs import check_root, choose_sets, read_rows
from jaxsfm.bench.options import PlanesOptions
from jaxsfm.config import PRESETS, Config, preset
from jaxsfm.core.ransac import peel_planes
from jaxsfm.errors import UserError
from jaxsfm.matching.pair_matching import thresholds

SUFFIX = "_pts.txt"
POINT_PX = 2.0
"""Inlier threshold. Detected points are exact to a pixel, cells of dense features to ten pixels."""
MIN_POINTS = 20
"""The smallest plane, in points: five minimal samples."""
MAX_PLANES = 12
ROUNDS = 20
_peel = jax.jit(peel_planes, static_argnames=("shape",))


class LabelledPoints(NamedTuple):
    """The labelled matches of one pair of images."""

    xy0: np.ndarray
    """float64 (n, 2), pixels."""
    xy1: np.ndarray
    """float64 (n, 2), pixels."""
    label: np.ndarray
    """int (n,): the plane of each match, from 0; -1 for outliers."""


class PlanesRow(TypedDict):
    """The figures of one file and one method."""

    set: str
    method: str
    points: int
    planes: int
    """The number of true planes."""
    found: Spread
    """The number of planes that were found."""
    misclassified: Spread


def read_points(path: Path) -> LabelledPoints:
    """Read rows of x1 y1 1 x2 y2 1 label, where label 0 marks an outlier.

    Raises:
      UserError: the file holds anything else.
    """
    rows = read_rows(path, 7, "rows of x1 y1 1 x2 y2 1 label")
    if (rows[:, 6] < 0).any():
        raise UserError(f"--root: {path}: labels must not be negative")
    return LabelledPoints(rows[:, :2], rows[:, 3:5], rows[:, 6].astype(int) - 1)


def misclassification(found: np.ndarray, truth: np.ndarray) -> float:
    """The share of points with a wrong label, under the best one-to-one assignment of planes.

    Args:
      found, truth: int (n,), the plane of each point; -1 for outliers.
    """
    table = np.zeros((found.max(initial=-1) + 1, truth.max(initial=-1) + 1), int)
    both = (found >= 0) & (truth >= 0)
    np.add.at(table, (found[both], truth[both]), 1)
    rows, columns = linear_sum_assignment(table, maximize=True)
    right = table[rows, columns].sum() + ((found < 0) & (truth < 0)).sum()
    return float(1.0 - right / len(truth))


def method_for_points(method: str) -> Config:
    """A preset, adapted to points instead of cells.

    `paper` keeps its constants (five planes, 10 pixels). The others have the threshold of points,
    find up to `MAX_PLANES` planes and let planes compete for points.
    """
    config = preset(method)
    if method == "paper":
        return config
    shape = dataclasses.replace(config.pair, max_planes=MAX_PLANES, plane_rounds=ROUNDS)
    return dataclasses.replace(config, threshold_px=POINT_PX, min_inliers=MIN_POINTS, pair=shape)


def fit_planes(points: LabelledPoints, config: Config, *, seed: int) -> np.ndarray:
    """Fit planes by sequential RANSAC; returns the plane of each point, int (n,), -1 for none."""
    found = _peel(
        jax.random.key(seed),
        jnp.asarray(points.xy0, jnp.float32),
        jnp.asarray(points.xy1, jnp.float32),
        jnp.ones(len(points.label), bool),
        thresholds(config),
        shape=config.pair,
    )
    return np.asarray(found.plane)


def bench_planes(options: PlanesOptions) -> BenchFigures[PlanesRow, None]:
    """Fit planes with all presets to all files NAME_pts.txt."""
    methods = options.chosen_methods(tuple(PRESETS))
    root = options.root
    check_root(root)
    found = {path.name.removesuffix(SUFFIX): path for path in root.glob(f"*{SUFFIX}")}
    if not found:
        raise UserError(f"--root {root}: no points (NAME{SUFFIX}) in it")
    inputs = {
        path.name.removesuffix(SUFFIX): read_points(path)
        for path in choose_sets(found, options.chosen_sets(), root)
    }

    def rows() -> Iterator[PlanesRow]:
        for name, points in inputs.items():
            for method in methods:
                config = method_for_points(method)
                labels = [fit_planes(points, config, seed=seed) for seed in range(options.seeds)]
                yield {
                    "set": name,
                    "method": method,
                    "points": len(points.label),
                    "planes": int(points.label.max() + 1),
                    "found": spread(len(set(label[label >= 0])) for label in labels),
                    "misclassified": spread(misclassification(x, points.label) for x in labels),
                }

    return collect("planes", rows(), lambda _: None, cells, options)


def cells(row: PlanesRow) -> Cells:
    """A row of the table."""
    wrong = row["misclassified"]
    return {
        "points": row["set"],
        "method": row["method"],
        "number": str(row["points"]),
        "planes": str(row["planes"]),
        "found": f"{row['found']['mean']:.1f}",
        **{f"wrong, {name}": f"{wrong[name]:.1%}" for name in ("mean", "min", "max")},
    }


def table_lines(result: BenchFigures[PlanesRow, None]) -> list[str]:
    """The table: misclassification by file, as mean, smallest and largest over the seeds."""
    return table([cells(row) for row in result["rows"]])
