"""`bench wxbs`: pairs under changes of viewpoint, illumination, season (Mishkin et al., BMVC 2015).

A fundamental matrix is estimated from a method's matches and judged on points marked by hand: the
share of them within 1, 2, .., 20 px of their epipolar lines, averaged (mAA).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsfm.bench.common import (
    Keep,
    check_root,
    choose_sets,
    read_rows,
    spread,
    usable_image,
)
from jaxsfm.bench.matches import Matcher, pair_figures
from jaxsfm.errors import UserError
from jaxsfm.io.images import SUFFIXES, ImageFile
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice
from jaxsfm.sfm.two_view import epipolar_residuals, fundamental_matrix

THRESHOLDS_PX = np.arange(1, 21)


def symmetric_epipolar_error(f: np.ndarray, xy0: np.ndarray, xy1: np.ndarray) -> np.ndarray:
    """Root of the summed squared distances of either point to the other's epipolar line, pixels.

    Args:
      f: float64 (3, 3), x1' F x0 = 0.
      xy0, xy1: float64 (n, 2).

    Source: Hartley and Zisserman, 2nd edition, equation 11.10.
    """
    residual, norm0, norm1 = epipolar_residuals(f, xy0, xy1)
    square = np.square(residual)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.sqrt(square / norm0 + square / norm1)
    return np.where(np.isfinite(error), error, np.inf)


def mean_average_accuracy(errors: np.ndarray) -> float:
    """Mean over 1 .. 20 px of the share of points within."""
    return float((errors[None] <= THRESHOLDS_PX[:, None]).mean())


def _image(folder: Path, stem: str) -> ImageFile:
    found = sorted(p for p in folder.glob(f"{stem}.*") if p.suffix.lower() in SUFFIXES)
    if not found:
        raise UserError(f"--root: {folder / stem}.png (or .jpg) is missing")
    return usable_image(found[0])


def bench_wxbs(
    root: Path,
    *,
    sets: Sequence[str] | None = None,
    methods: Sequence[str],
    seeds: int = 5,
    max_size: int | None = None,
    network: WeightsChoice = USUAL_WEIGHTS,
    progress: bool = False,
    keep: Keep = lambda _: None,
) -> dict[str, Any]:
    """All methods on all pairs (CATEGORY/NAME/{01,02}.png, corrs.txt); plain JSON.

    Args:
      root: folder of the categories.
      sets: CATEGORY/NAME, or CATEGORY for all of it; default: all.
      seeds: runs of each method with seeds 0, 1, ..; of RANSAC in matching and of the fundamental
        matrix.
      max_size: longer side of our working images; None: the preset's.
      network: the files of its parameters.
    """
    check_root(root)
    found = {
        f"{path.parent.parent.name}/{path.parent.name}": path.parent
        for path in root.glob("*/*/corrs.txt")
    }
    if not found:
        raise UserError(f"--root {root}: no pairs (CATEGORY/NAME/corrs.txt) in it")
    if sets is not None:
        whole = {name.split("/")[0] for name in found} & set(sets)
        named = [name for name in found if name.split("/")[0] in whole]
        sets = sorted({*named, *(name for name in sets if name not in whole)})
    folders = choose_sets(found, sets, root)
    inputs = {
        folder: (
            _image(folder, "01"),
            _image(folder, "02"),
            read_rows(folder / "corrs.txt", 4, "rows of x1 y1 x2 y2"),
        )
        for folder in folders
    }
    matcher = Matcher(network)
    rows = []
    for folder, (image0, image1, marked) in inputs.items():
        for method in methods:
            runs = matcher.match(image0, image1, method, range(seeds), max_size=max_size)
            scores = []
            for seed, run in enumerate(runs):
                f = fundamental_matrix(run.xy0, run.xy1, seed=seed)
                if f is None:
                    scores.append(0.0)
                else:
                    error = symmetric_epipolar_error(f, marked[:, :2], marked[:, 2:])
                    scores.append(mean_average_accuracy(error))
            rows.append(
                {
                    "pair": f"{folder.parent.name}/{folder.name}",
                    "category": folder.parent.name,
                    "method": method,
                    "maa": spread(scores),
                    "scores": scores,
                    "matches": spread(len(run.xy0) for run in runs),
                    "seconds": float(np.median([run.seconds for run in runs])),
                }
            )
            if progress:
                print(row_line(rows[-1]), flush=True)
            keep(pair_figures("wxbs", rows, means(rows), seeds, max_size))
    return pair_figures("wxbs", rows, means(rows), seeds, max_size)


def means(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Per method: mAA over the pairs of each category and over all, and its spread over seeds."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        groups = {
            category: [r for r in own if r["category"] == category]
            for category in sorted({row["category"] for row in own})
        }
        groups["all"] = own
        result[method] = {
            name: spread(np.mean([row["scores"] for row in group], axis=0))
            for name, group in groups.items()
        }
    return result


def row_line(row: dict[str, Any]) -> str:
    """One line of the table."""
    maa = row["maa"]
    return (
        f"{row['pair']:28s} {row['method']:9s} {maa['mean']:6.3f} {maa['min']:6.3f} "
        f"{maa['max']:6.3f} {row['matches']['mean']:8.0f} {row['seconds']:8.2f}"
    )


def table_lines(result: dict[str, Any]) -> list[str]:
    """mAA per pair and category: mean, least and largest over the seeds."""
    figures = f"{'mAA':>6s} {'min':>6s} {'max':>6s} {'matches':>8s} {'seconds':>8s}"
    lines = [f"{'pair':28s} {'method':9s} {figures}"]
    lines += [row_line(row) for row in result["rows"]]
    for method, groups in result["means"].items():
        for name, figure in groups.items():
            lines.append(
                f"{'mean of ' + name:28s} {method:9s} {figure['mean']:6.3f} {figure['min']:6.3f} "
                f"{figure['max']:6.3f}"
            )
    return lines
