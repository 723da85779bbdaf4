"""`bench homography`: sequences with known homographies (Oxford affine, HPatches).

Matching accuracy: the share of a method's matches within 1, 3, 5, 10 px of where the true
homography puts them. Corner error: how far a homography estimated from the matches moves image 1's
corners (mean of four), as the area under its cumulative curve up to 3, 5, 10 px.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
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
from jaxsfm.sfm.two_view import homography

ACCURACY_PX = (1, 3, 5, 10)
CORNER_PX = (3, 5, 10)
TRUTH_NAME = re.compile(r"H_?1(?:to|_)(\d+)p?(?:\.xml|\.txt)?")
"""H1to2p, H1to2p.xml (Oxford), H_1_2 (HPatches)."""


class KnownPair(NamedTuple):
    """The first image of a sequence against another one."""

    name: str
    image0: ImageFile
    image1: ImageFile
    h: np.ndarray
    """float64 (3, 3): first image to the other, pixels."""


def warp(h: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Points (n, 2) through a homography; what goes to infinity is nan or inf."""
    moved = np.c_[xy, np.ones(len(xy))] @ h.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return moved[:, :2] / moved[:, 2:]


def match_errors(h: np.ndarray, xy0: np.ndarray, xy1: np.ndarray) -> np.ndarray:
    """Distance of each match's second point from the first one's true place, pixels."""
    error = np.linalg.norm(warp(h, xy0) - xy1, axis=1)
    return np.where(np.isfinite(error), error, np.inf)


def corner_error(found: np.ndarray | None, truth: np.ndarray, size: tuple[int, int]) -> float:
    """Mean distance of the four corners under the two homographies, pixels; inf without one.

    Args:
      size: (width, height) of the first image.
    """
    if found is None:
        return np.inf
    w, h = size
    corners = np.asarray([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], np.float64)
    error = float(np.linalg.norm(warp(found, corners) - warp(truth, corners), axis=1).mean())
    return error if np.isfinite(error) else np.inf


def _finite(value: float) -> float | None:
    """For JSON, which has no infinity."""
    return value if np.isfinite(value) else None


def _with_inf(errors: Sequence[float | None]) -> list[float]:
    return [np.inf if error is None else error for error in errors]


def area_under_curve(errors: Sequence[float | None], limit: float) -> float:
    """Area under the cumulative curve of the errors up to `limit`, as a share of the best.

    Args:
      errors: None where there was no estimate.
    """
    return float(np.maximum(0.0, 1.0 - np.asarray(_with_inf(errors)) / limit).mean())


def read_homography(path: Path) -> np.ndarray:
    """A 3 x 3 matrix as text or in OpenCV's XML.

    Raises:
      UserError: it is neither.
    """
    h = None
    try:
        if path.suffix == ".xml":
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
            h = storage.root().getNode(storage.root().keys()[0]).mat() if storage.isOpened() else h
        else:
            h = read_rows(path, 3, "a homography (3 x 3)")
    except (IndexError, cv2.error, SystemError):
        h = None
    if h is None or h.shape != (3, 3) or not np.isfinite(h).all() or np.linalg.det(h) == 0:
        raise UserError(f"--root: {path} must hold a homography (3 x 3)")
    return np.asarray(h, np.float64)


def read_sequence(folder: Path) -> list[KnownPair]:
    """The pairs of a sequence; images are imgK.* or K.*.

    Raises:
      UserError: an image or a homography is missing or damaged.
    """
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        number = re.fullmatch(r"(?:img)?(\d+)", path.stem)
        if number and path.suffix.lower() in SUFFIXES:
            files[int(number[1])] = path
    images: dict[int, ImageFile] = {}
    pairs: dict[int, KnownPair] = {}
    for path in sorted(folder.iterdir()):
        if (named := TRUTH_NAME.fullmatch(path.name)) is None:
            continue
        other = int(named[1])
        for k in (1, other):
            if k not in files:
                raise UserError(f"--root: {folder}: image {k} is missing, named by {path.name}")
            if k not in images:
                images[k] = usable_image(files[k])
        h = read_homography(path)
        if other in pairs and not np.allclose(h, pairs[other].h):
            raise UserError(f"--root: {path} contradicts another homography of image {other}")
        pairs[other] = KnownPair(f"{folder.name} 1-{other}", images[1], images[other], h)
    return [pairs[other] for other in sorted(pairs)]


def bench_homography(
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
    """All methods on all sequences; plain JSON.

    Args:
      root: folder of sequences (SEQUENCE/img1.png, H1to2p; or SEQUENCE/1.ppm, H_1_2).
      seeds: runs of each method with seeds 0, 1, ...
      max_size: longer side of our working images, pixels; None: the preset's.
      network: the files of its parameters.
    """
    check_root(root)
    found = {
        path.name: path
        for path in root.iterdir()
        if path.is_dir() and any(TRUTH_NAME.fullmatch(file.name) for file in path.iterdir())
    }
    if not found:
        raise UserError(f"--root {root}: no sequences (SEQUENCE/H1to2p or H_1_2) in it")
    sequences = {f.name: read_sequence(f) for f in choose_sets(found, sets, root)}
    matcher = Matcher(network)
    rows = []
    for set_name, pairs in sequences.items():
        for pair in pairs:
            size = pair.image0.size
            for method in methods:
                runs = matcher.match(
                    pair.image0, pair.image1, method, range(seeds), max_size=max_size
                )
                errors = [match_errors(pair.h, run.xy0, run.xy1) for run in runs]
                rows.append(
                    {
                        "set": set_name,
                        "pair": pair.name,
                        "method": method,
                        "matches": spread(len(error) for error in errors),
                        "correct": {
                            str(t): spread((error <= t).sum() for error in errors)
                            for t in ACCURACY_PX
                        },
                        "accuracy": {
                            str(t): spread(
                                (error <= t).mean() if len(error) else 0.0 for error in errors
                            )
                            for t in ACCURACY_PX
                        },
                        "corner_error_px": [
                            _finite(
                                corner_error(homography(run.xy0, run.xy1, seed=seed), pair.h, size)
                            )
                            for seed, run in enumerate(runs)
                        ],
                        "seconds": float(np.median([run.seconds for run in runs])),
                    }
                )
                if progress:
                    print(row_line(rows[-1]), flush=True)
                keep(pair_figures("homography", rows, means(rows), seeds, max_size))
    return pair_figures("homography", rows, means(rows), seeds, max_size)


def means(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Per method and set: matches, correct ones (3 px), accuracies, corner AUC."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for row in rows:
        result.setdefault(row["method"], {}).setdefault(row["set"], {})
    for method, sets in result.items():
        for name in sets:
            own = [row for row in rows if (row["method"], row["set"]) == (method, name)]
            corners = [error for row in own for error in row["corner_error_px"]]
            sets[name] = {
                "matches": float(np.mean([row["matches"]["mean"] for row in own])),
                "correct_3": float(np.mean([row["correct"]["3"]["mean"] for row in own])),
            }
            for t in ACCURACY_PX:
                values = [row["accuracy"][str(t)]["mean"] for row in own]
                sets[name][f"accuracy_{t}"] = float(np.mean(values))
            for t in CORNER_PX:
                sets[name][f"corner_auc_{t}"] = area_under_curve(corners, t)
    return result


HEADER = (
    f"{'pair':20s} {'method':9s} {'matches':>8s} {'<= 3 px':>8s} "
    + " ".join(f"{f'acc {t}':>7s}" for t in ACCURACY_PX)
    + f" {'corner':>9s} {'seconds':>8s}"
)


def row_line(row: dict[str, Any]) -> str:
    """One line of the table; the corner error is the median over the seeds."""
    accuracy = " ".join(f"{row['accuracy'][str(t)]['mean']:7.3f}" for t in ACCURACY_PX)
    return (
        f"{row['pair']:20s} {row['method']:9s} {row['matches']['mean']:8.0f} "
        f"{row['correct']['3']['mean']:8.0f} {accuracy} "
        f"{np.median(_with_inf(row['corner_error_px'])):9.2f} {row['seconds']:8.2f}"
    )


def table_lines(result: dict[str, Any]) -> list[str]:
    """Accuracy per pair, and means over each sequence with the corner errors' AUC."""
    lines = [HEADER, *(row_line(row) for row in result["rows"])]
    for method, sets in result["means"].items():
        for name, m in sets.items():
            accuracy = " ".join(f"{m[f'accuracy_{t}']:7.3f}" for t in ACCURACY_PX)
            areas = ", ".join(f"{m[f'corner_auc_{t}']:.3f}" for t in CORNER_PX)
            lines.append(
                f"{'mean of ' + name:20s} {method:9s} {m['matches']:8.0f} {m['correct_3']:8.0f} "
                f"{accuracy} AUC 3, 5, 10 px: {areas}"
            )
    return lines
