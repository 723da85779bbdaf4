"""`bench wxbs`: pairs under changes of viewpoint, illumination, season (Mishkin et al., BMVC 2015).

A fundamental matrix is estimated from a method's matches and judged on points that were marked by
hand. The figure is the mean average accuracy (mAA): the share of these points within t pixels of
their epipolar lines, averaged over t = 1, 2, ..., 20.
"""

import functools
import hashlib
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypedDict

import numpy as np

from jaxsfm.bench.figures import BenchFigures, Cells, Spread, collect, spread, table
from jaxsfm.bench.inputs import check_root, choose_sets, read_rows, usable_image
from jaxsfm.bench.methods import METHODS, NAIVE, method_config
from jaxsfm.bench.options import WxbsOptions
from jaxsfm.bench.other_methods import match_pairs_naively
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import read_matches
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.photo_folder import SUFFIXES
from jaxsfm.io.weights import chosen_weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.sfm.epipolar import epipolar_residuals, fundamental_matrix, single_fundamental_matrix
from jaxsfm.sfm.two_photos.pair_passes import match_photos

THRESHOLDS_PX = np.arange(1, 21)
PUBLISHED_THRESHOLDS_PX = np.arange(11)
"""The limits of the figures that are published as mAA at 10 px (`--protocol lo`)."""
PUBLISHED = {"DKM": 0.589, "RoMa": 0.801}
"""Published mAA at 10 px of all pairs of the benchmark, most of which are not among those at hand
(Edstedt et al., "RoMa: Robust Dense Feature Matching", CVPR 2024)."""
HALVES = ("half A", "half B")
"""The pairs are split by a hash of their names, so that choices can be made on half A and reported
on half B."""
FEATURES = 8
"""How many images' features are held: those of two images for each of four methods."""
Means = dict[str, dict[str, Spread]]
"""mAA by method and category."""


class WxbsRow(TypedDict):
    """The figures of one pair and one method."""

    pair: str
    half: str
    """`HALVES`."""
    category: str
    method: str
    maa: Spread
    scores: list[float]
    """mAA for each seed."""
    matches: Spread
    significance: Spread | None
    """How strongly the matches speak for the pair (`jaxsfm.sfm.two_photos.matching_pass`)."""
    seconds: float


def symmetric_epipolar_error(f: np.ndarray, xy0: np.ndarray, xy1: np.ndarray) -> np.ndarray:
    """Symmetric epipolar distance of matches in pixels, float64 (n,).

    It is the root of the sum of the squared distances of the two points from the epipolar lines of
    each other; where a line is not defined it is infinite.

    Args:
      f: float64 (3, 3), the fundamental matrix: x1' F x0 = 0.
      xy0, xy1: float64 (n, 2), pixels.

    Source: Hartley and Zisserman, 2nd edition, equation 11.10.
    """
    residual, norm0, norm1 = epipolar_residuals(f, xy0, xy1)
    square = np.square(residual)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.sqrt(square / norm0 + square / norm1)
    return np.where(np.isfinite(error), error, np.inf)


def mean_average_accuracy(errors: np.ndarray, thresholds: np.ndarray = THRESHOLDS_PX) -> float:
    """The share of errors (pixels) within t, averaged over the thresholds t (1, 2, ..., 20)."""
    return float((errors[None] <= thresholds[:, None]).mean())


def half_of(pair: str) -> str:
    """The half (`HALVES`) that a pair CATEGORY/NAME belongs to."""
    return HALVES[hashlib.sha256(pair.encode()).digest()[0] % 2]


def _image(folder: Path, stem: str) -> ImageFile:
    found = sorted(p for p in folder.glob(f"{stem}.*") if p.suffix.lower() in SUFFIXES)
    if not found:
        raise UserError(f"--root: {folder / stem}.png (or .jpg) is missing")
    return usable_image(found[0])


class Matches(NamedTuple):
    """The matches of one pair by one method with one seed."""

    xy0: np.ndarray
    """float64 (n, 2): original pixels, centre of the top-left pixel (0, 0)."""
    xy1: np.ndarray
    seconds: float
    """Time of extracting both images and of matching; the first image of a size also compiles."""
    significance: float | None = None
    """How strongly the matches speak for the pair (`jaxsfm.sfm.two_photos`); None if the method
    does not say it."""


class Matcher:
    """Matches pairs of images.

    The features of an image are computed once for all its pairs and all methods that use the same
    features.
    """

    def __init__(self, options: WxbsOptions) -> None:
        self._options = options
        self._weights = functools.cache(functools.partial(chosen_weights, options.network))
        self._extract = functools.lru_cache(maxsize=FEATURES)(self._timed_features)

    def match(self, image0: ImageFile, image1: ImageFile, method: str) -> list[Matches]:
        """The matches of a pair for each seed.

        Args:
          image0, image1: two images of one folder, called by their files' names.
          method: one of `METHODS`.
        """
        seeds = range(self._options.seeds)
        if method == "rootsift":
            start = time.monotonic()
            xy0, xy1 = _rootsift(image0, image1)
            taken = time.monotonic() - start
            return [Matches(xy0, xy1, taken)] * len(seeds)  # nothing is random
        config = method_config(method, max_size=self._options.max_size)
        if method == NAIVE:
            return [self._naive(image0, image1, config, seed) for seed in seeds]
        (features0, seconds0), (features1, seconds1) = (
            self._extract(image, config.extraction()) for image in (image0, image1)
        )
        results = []
        for seed in seeds:
            start = time.monotonic()
            weights = self._weights(config.backbone)
            found = match_photos(weights, features0, features1, config=config, seed=seed)
            taken = seconds0 + seconds1 + time.monotonic() - start
            xy0, xy1 = found.result.keypoints0.astype(np.float64), found.aligned.keypoints1
            results.append(Matches(xy0, xy1, taken, found.significance))
        return results

    def _naive(self, image0: ImageFile, image1: ImageFile, config: Config, seed: int) -> Matches:
        start = time.monotonic()
        images = {image.name: image for image in (image0, image1)}
        weights = self._weights(config.backbone)
        pair = (image0.name, image1.name)
        (found,) = match_pairs_naively(weights, images, [pair], config=config, seed=seed)
        xy0, xy1 = (xy.astype(np.float64) for xy in (found.keypoints0, found.keypoints1))
        return Matches(xy0, xy1, time.monotonic() - start)

    def _timed_features(self, image: ImageFile, config: Config) -> tuple[ImageFeatures, float]:
        weights = self._weights(config.backbone)
        start = time.monotonic()
        features = image_features(weights, image, config=config)
        return features, time.monotonic() - start


def _rootsift(image0: ImageFile, image1: ImageFile) -> tuple[np.ndarray, np.ndarray]:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        database = Path(scratch) / "database.db"
        # A fundamental matrix needs eight matches.
        write_rootsift_database(
            database,
            image0.path.parent,
            [image0, image1],
            Cameras(),
            VerificationOptions(min_inliers=8),
        )
        return read_matches(database, (image0.name, image1.name), verified=False)


def bench_wxbs(options: WxbsOptions) -> BenchFigures[WxbsRow, Means]:
    """Run all methods on all pairs (CATEGORY/NAME/{01,02}.png, corrs.txt)."""
    methods = options.chosen_methods(METHODS)
    inputs = {
        folder: (
            _image(folder, "01"),
            _image(folder, "02"),
            read_rows(folder / "corrs.txt", 4, "rows of x1 y1 x2 y2"),
        )
        for folder in _folders(options)
    }
    matcher = Matcher(options)

    def rows() -> Iterator[WxbsRow]:
        for folder, (image0, image1, marked) in inputs.items():
            for method in methods:
                runs = matcher.match(image0, image1, method)
                yield _row(folder, method, runs, marked, published=options.protocol == "lo")

    return collect("wxbs", rows(), means, cells, options)


def _folders(options: WxbsOptions) -> list[Path]:
    """The folders of the chosen pairs; the name of a category stands for all its pairs."""
    root, sets = options.root, options.chosen_sets()
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
    return choose_sets(found, sets, root)


def _row(
    folder: Path, method: str, runs: Sequence[Matches], marked: np.ndarray, *, published: bool
) -> WxbsRow:
    scores = []
    for seed, run in enumerate(runs):
        if published:
            f = single_fundamental_matrix(run.xy0, run.xy1)
        else:
            f = fundamental_matrix(run.xy0, run.xy1, seed=seed)
        if f is None:
            scores.append(0.0)
        else:
            error = symmetric_epipolar_error(f, marked[:, :2], marked[:, 2:])
            limits = PUBLISHED_THRESHOLDS_PX if published else THRESHOLDS_PX
            scores.append(mean_average_accuracy(error, limits))
    name = f"{folder.parent.name}/{folder.name}"
    significance = [run.significance for run in runs if run.significance is not None]
    return {
        "pair": name,
        "half": half_of(name),
        "category": folder.parent.name,
        "method": method,
        "maa": spread(scores),
        "scores": scores,
        "matches": spread(len(run.xy0) for run in runs),
        "significance": spread(significance) if significance else None,
        "seconds": float(np.median([run.seconds for run in runs])),
    }


def means(rows: Sequence[WxbsRow]) -> Means:
    """The mAA of each method over the pairs of each category and half, and over all ("all").

    Pairs are averaged first, so that the spread is that over the seeds.
    """
    result: Means = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        groups = {
            category: [r for r in own if r["category"] == category]
            for category in sorted({row["category"] for row in own})
        }
        for half in HALVES:
            if some := [r for r in own if r["half"] == half]:
                groups[half] = some
        groups["all"] = own
        result[method] = {
            name: spread(np.mean([row["scores"] for row in group], axis=0))
            for name, group in groups.items()
        }
    return result


def cells(row: WxbsRow) -> Cells:
    """A row of the table."""
    return {
        "pair": row["pair"],
        "method": row["method"],
        **_maa(row["maa"]),
        "matches": f"{row['matches']['mean']:.0f}",
        "significance": "" if row["significance"] is None else f"{row['significance']['mean']:.0f}",
        "seconds": f"{row['seconds']:.2f}",
    }


def _maa(figure: Spread) -> Cells:
    return {name: f"{figure[name]:.3f}" for name in ("mean", "min", "max")}


def table_lines(result: BenchFigures[WxbsRow, Means]) -> list[str]:
    """The table: mAA by pair and category, as mean, smallest and largest over the seeds."""
    groups = [
        {"pair": f"mean of {name}", "method": method, **_maa(figure)}
        for method, categories in result["summary"].items()
        for name, figure in categories.items()
    ]
    published = [
        {"pair": "published, all pairs", "method": method, "mean": f"{maa:.3f}"}
        for method, maa in PUBLISHED.items()
        if result["options"]["protocol"] == "lo"
    ]
    return table([*map(cells, result["rows"]), *groups, *published])
