"""`bench homography`: sequences with known homographies (Oxford affine, HPatches).

Two figures are measured. Matching accuracy is the share of a method's matches whose second point
lies within 1, 3, 5 or 10 pixels of the place where the true homography puts the first one. The
corner error is the distance between the corners of image 1 under the true homography and under one
estimated from the matches, averaged over the four corners; it is summed up as the area under its
cumulative curve up to 3, 5 and 10 pixels.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypedDict

import cv2
import numpy as np

from jaxsfm.bench.figures import BenchFigures, Cells, Spread, collect, spread, table
from jaxsfm.bench.inputs import check_root, choose_sets, read_rows, usable_image
from jaxsfm.bench.matches import Matcher, Matches
from jaxsfm.bench.methods import PAIR_METHODS
from jaxsfm.bench.pair_options import HomographyOptions
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile
from jaxsfm.io.photo_folder import SUFFIXES
from jaxsfm.sfm.epipolar import homography

ACCURACY_PX = (1, 3, 5, 10)
CORNER_PX = (3, 5, 10)
TRUTH_NAME = re.compile(r"H_?1(?:to|_)(\d+)p?(?:\.xml|\.txt)?")
"""File names of homographies: H1to2p and H1to2p.xml (Oxford), H_1_2 (HPatches)."""


class KnownPair(NamedTuple):
    """The first image of a sequence and another one."""

    name: str
    image0: ImageFile
    image1: ImageFile
    h: np.ndarray
    """float64 (3, 3): maps pixels of the first image to pixels of the other one."""


class HomographyRow(TypedDict):
    """The figures of one pair and one method."""

    set: str
    pair: str
    method: str
    matches: Spread
    correct: dict[str, Spread]
    """The number of matches within each of `ACCURACY_PX`."""
    accuracy: dict[str, Spread]
    """The share of matches within each of `ACCURACY_PX`."""
    corner_error_px: list[float | None]
    """For each seed; None where no homography was found."""
    seconds: float


Means = dict[str, dict[str, dict[str, float]]]
"""The mean of each figure, by method and set."""


def warp(h: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Map points (n, 2) by a homography; points at infinity become nan or inf."""
    moved = np.c_[xy, np.ones(len(xy))] @ h.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return moved[:, :2] / moved[:, 2:]


def match_errors(h: np.ndarray, xy0: np.ndarray, xy1: np.ndarray) -> np.ndarray:
    """Distance in pixels of each match's second point from the true place of its first point."""
    error = np.linalg.norm(warp(h, xy0) - xy1, axis=1)
    return np.where(np.isfinite(error), error, np.inf)


def corner_error(found: np.ndarray | None, truth: np.ndarray, size: tuple[int, int]) -> float:
    """Mean distance in pixels between the four corners under the two homographies.

    Args:
      found: the estimated homography; without one (None) the error is infinite.
      size: (width, height) of the first image.
    """
    if found is None:
        return np.inf
    w, h = size
    corners = np.asarray([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], np.float64)
    error = float(np.linalg.norm(warp(found, corners) - warp(truth, corners), axis=1).mean())
    return error if np.isfinite(error) else np.inf


def _finite(value: float) -> float | None:
    """The value, or None if it is infinite: JSON has no infinity."""
    return value if np.isfinite(value) else None


def _with_inf(errors: Sequence[float | None]) -> list[float]:
    return [np.inf if error is None else error for error in errors]


def area_under_curve(errors: Sequence[float | None], limit: float) -> float:
    """Area under the cumulative curve of the errors up to `limit`, divided by `limit`.

    Args:
      errors: None stands for an infinite error.
    """
    return float(np.maximum(0.0, 1.0 - np.asarray(_with_inf(errors)) / limit).mean())


def read_homography(path: Path) -> np.ndarray:
    """Read a 3 x 3 matrix, float64, from a text file or from OpenCV's XML.

    Raises:
      UserError: the file holds neither, or the matrix is singular.
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
    """The pairs of a sequence, whose images are called imgK.* or K.*.

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


def bench_homography(options: HomographyOptions) -> BenchFigures[HomographyRow, Means]:
    """Run all methods on all sequences."""
    methods = options.chosen_methods(PAIR_METHODS)
    check_root(options.root)
    found = {
        path.name: path
        for path in options.root.iterdir()
        if path.is_dir() and any(TRUTH_NAME.fullmatch(file.name) for file in path.iterdir())
    }
    if not found:
        raise UserError(f"--root {options.root}: no sequences (SEQUENCE/H1to2p or H_1_2) in it")
    folders = choose_sets(found, options.chosen_sets(), options.root)
    sequences = {folder.name: read_sequence(folder) for folder in folders}
    matcher = Matcher(options)

    def rows() -> Iterator[HomographyRow]:
        for name, pairs in sequences.items():
            for pair in pairs:
                for method in methods:
                    runs = matcher.match(pair.image0, pair.image1, method)
                    yield _row(name, pair, method, runs)

    return collect("homography", rows(), means, cells, options)


def _row(name: str, pair: KnownPair, method: str, runs: Sequence[Matches]) -> HomographyRow:
    errors = [match_errors(pair.h, run.xy0, run.xy1) for run in runs]
    found = [homography(run.xy0, run.xy1, seed=seed) for seed, run in enumerate(runs)]
    return {
        "set": name,
        "pair": pair.name,
        "method": method,
        "matches": spread(len(error) for error in errors),
        "correct": {str(t): spread((error <= t).sum() for error in errors) for t in ACCURACY_PX},
        "accuracy": {
            str(t): spread((error <= t).mean() if len(error) else 0.0 for error in errors)
            for t in ACCURACY_PX
        },
        "corner_error_px": [_finite(corner_error(h, pair.h, pair.image0.size)) for h in found],
        "seconds": float(np.median([run.seconds for run in runs])),
    }


def means(rows: Sequence[HomographyRow]) -> Means:
    """By method and set: matches, correct ones (3 px), accuracies and areas of corner errors."""
    result: Means = {}
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


def cells(row: HomographyRow) -> Cells:
    """A row of the table, with the median corner error over the seeds."""
    return {
        "pair": row["pair"],
        "method": row["method"],
        "matches": f"{row['matches']['mean']:.0f}",
        "<= 3 px": f"{row['correct']['3']['mean']:.0f}",
        **{f"accuracy {t}": f"{row['accuracy'][str(t)]['mean']:.3f}" for t in ACCURACY_PX},
        "corner error": f"{np.median(_with_inf(row['corner_error_px'])):.2f}",
        "seconds": f"{row['seconds']:.2f}",
    }


def _mean_cells(method: str, name: str, mean: dict[str, float]) -> Cells:
    return {
        "pair": f"mean of {name}",
        "method": method,
        "matches": f"{mean['matches']:.0f}",
        "<= 3 px": f"{mean['correct_3']:.0f}",
        **{f"accuracy {t}": f"{mean[f'accuracy_{t}']:.3f}" for t in ACCURACY_PX},
        **{f"corner AUC {t}": f"{mean[f'corner_auc_{t}']:.3f}" for t in CORNER_PX},
    }


def table_lines(result: BenchFigures[HomographyRow, Means]) -> list[str]:
    """The table: accuracy by pair, then the means of each sequence and its areas under curves."""
    means_of_sets = [
        _mean_cells(method, name, mean)
        for method, sets in result["summary"].items()
        for name, mean in sets.items()
    ]
    return table([*map(cells, result["rows"]), *means_of_sets])
