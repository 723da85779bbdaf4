"""`bench planes`: several homographies fitted to given points (AdelaideRMF, Wong et al. 2011).

Points are labelled by hand: outlier, or one of the scene's planes. Misclassification is the share
of points with a wrong label under the best assignment of found planes to true ones.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxsfm.bench.common import Keep, check_root, choose_sets, read_rows, spread
from jaxsfm.config import Config, preset
from jaxsfm.core.ransac import peel_planes
from jaxsfm.errors import UserError
from jaxsfm.io.versions import package_versions
from jaxsfm.matching.pair_matching import thresholds

SUFFIX = "_pts.txt"
POINT_PX = 2.0
"""Inlier radius: detected points lie within a pixel, cells of dense features within ten."""
LEAST_POINTS = 20
"""Of a plane: five minimal samples."""
MAX_PLANES = 12
ROUNDS = 20
_peel = jax.jit(peel_planes, static_argnames=("shape",))


class LabelledPoints(NamedTuple):
    """One pair's points."""

    xy0: np.ndarray
    xy1: np.ndarray
    label: np.ndarray
    """int (n,): -1 for outliers, planes from 0."""


def read_points(path: Path) -> LabelledPoints:
    """Rows of x1 y1 1 x2 y2 1 label (0: outlier).

    Raises:
      UserError: something else is in the file.
    """
    rows = read_rows(path, 7, "rows of x1 y1 1 x2 y2 1 label")
    if (rows[:, 6] < 0).any():
        raise UserError(f"--root: {path}: labels must not be negative")
    return LabelledPoints(rows[:, :2], rows[:, 3:5], rows[:, 6].astype(int) - 1)


def misclassification(found: np.ndarray, truth: np.ndarray) -> float:
    """Share of points with a wrong label, under the best one-to-one assignment of the planes.

    Args:
      found, truth: int (n,); -1 for outliers.
    """
    table = np.zeros((found.max(initial=-1) + 1, truth.max(initial=-1) + 1), int)
    both = (found >= 0) & (truth >= 0)
    np.add.at(table, (found[both], truth[both]), 1)
    rows, columns = linear_sum_assignment(table, maximize=True)
    right = table[rows, columns].sum() + ((found < 0) & (truth < 0)).sum()
    return float(1.0 - right / len(truth))


def method_for_points(method: str) -> Config:
    """A preset made for given points: `paper` keeps its five planes of 10 px, the others fit
    points, as many planes as there are, and let them compete."""
    config = preset(method)
    if method == "paper":
        return config
    shape = dataclasses.replace(config.pair, max_planes=MAX_PLANES, plane_rounds=ROUNDS)
    return dataclasses.replace(config, threshold_px=POINT_PX, min_inliers=LEAST_POINTS, pair=shape)


def fit_planes(points: LabelledPoints, config: Config, *, seed: int) -> np.ndarray:
    """The plane of each point, int (n,), -1 for none: our peeling on the given points."""
    found = _peel(
        jax.random.key(seed),
        jnp.asarray(points.xy0, jnp.float32),
        jnp.asarray(points.xy1, jnp.float32),
        jnp.ones(len(points.label), bool),
        thresholds(config),
        shape=config.pair,
    )
    return np.asarray(found.plane)


def bench_planes(
    root: Path,
    *,
    sets: Sequence[str] | None = None,
    methods: Sequence[str],
    seeds: int = 5,
    progress: bool = False,
    keep: Keep = lambda _: None,
) -> dict[str, Any]:
    """Presets' plane fitting on all files NAME_pts.txt; plain JSON.

    Args:
      root: folder of the files.
      methods: presets.
      seeds: runs with seeds 0, 1, ...
    """
    check_root(root)
    found = {path.name.removesuffix(SUFFIX): path for path in root.glob(f"*{SUFFIX}")}
    if not found:
        raise UserError(f"--root {root}: no points (NAME{SUFFIX}) in it")
    inputs = {
        path.name.removesuffix(SUFFIX): read_points(path) for path in choose_sets(found, sets, root)
    }
    rows = []
    for name, points in inputs.items():
        for method in methods:
            config = method_for_points(method)
            labels = [fit_planes(points, config, seed=seed) for seed in range(seeds)]
            rows.append(
                {
                    "set": name,
                    "method": method,
                    "points": len(points.label),
                    "planes": int(points.label.max() + 1),
                    "found": spread(len(set(label[label >= 0])) for label in labels),
                    "misclassified": spread(misclassification(x, points.label) for x in labels),
                }
            )
            if progress:
                print(row_line(rows[-1]), flush=True)
            keep(_result(rows, seeds))
    return _result(rows, seeds)


def _result(rows: list[dict[str, Any]], seeds: int) -> dict[str, Any]:
    return {"benchmark": "planes", "versions": package_versions(), "seeds": seeds, "rows": rows}


def row_line(row: dict[str, Any]) -> str:
    """One line of the table."""
    wrong = row["misclassified"]
    return (
        f"{row['set']:20s} {row['method']:9s} {row['points']:7d} {row['planes']:7d} "
        f"{row['found']['mean']:7.1f} {wrong['mean']:8.1%} {wrong['min']:7.1%} {wrong['max']:7.1%}"
    )


def table_lines(result: dict[str, Any]) -> list[str]:
    """Misclassification per file: mean, least and largest over the seeds."""
    head = (
        f"{'points':20s} {'method':9s} {'number':>7s} {'planes':>7s} {'found':>7s} "
        f"{'wrong':>8s} {'min':>7s} {'max':>7s}"
    )
    return [head, *(row_line(row) for row in result["rows"])]
