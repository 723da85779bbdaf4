"""`bench poses`: pairs of photos with a known relative pose (ScanNet-1500, MegaDepth-1500).

An essential matrix is estimated from a method's matches and the known cameras. The error of a pair
is the angle by which its rotation or the direction of its translation is off, whichever is larger.
It is summed up as the area under its cumulative curve up to 5, 10 and 20 degrees.

Source: Sarlin, DeTone, Malisiewicz and Rabinovich 2020, "SuperGlue: Learning feature matching with
graph neural networks", section 5.2.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypedDict

import cv2
import numpy as np

from jaxsfm.bench.figures import BenchFigures, Cells, Spread, collect, spread, table
from jaxsfm.bench.homography import area_under_curve
from jaxsfm.bench.inputs import check_root, usable_image
from jaxsfm.bench.matches import Matcher, Matches
from jaxsfm.bench.methods import PAIR_METHODS
from jaxsfm.bench.pair_options import PosesOptions
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile

LIMITS_DEG = (5, 10, 20)
THRESHOLD_PX = 0.5
"""Largest error of an inlier of the essential matrix, original pixels: that of LoFTR (Sun, Shen,
Wang, Bao and Zhou 2021)."""
CONFIDENCE = 0.99999
"""Of RANSAC, likewise."""


class RelativePose(NamedTuple):
    """How the camera of the second photo lies to that of the first one."""

    rotation: np.ndarray
    """float64 (3, 3): from the first camera to the second one."""
    translation: np.ndarray
    """float64 (3,), likewise. Its length is of no meaning."""


class PosedPair(NamedTuple):
    """Two photos with known cameras."""

    images: tuple[ImageFile, ImageFile]
    cameras: tuple[np.ndarray, np.ndarray]
    """float64 (3, 3) each: the camera matrices."""
    truth: RelativePose


class PosesRow(TypedDict):
    """The figures of one pair and one method."""

    pair: str
    method: str
    matches: Spread
    errors_deg: list[float | None]
    """For each seed; None where no pose was found."""
    seconds: float


Areas = dict[str, dict[str, float]]
"""Of each method, the areas under the curve, by limit."""


def read_pairs(file: Path, root: Path) -> list[PosedPair]:
    """Read pairs of photos and their poses from a text file.

    A row has the names of both photos, K of both (9 numbers each), and the pose of the second
    camera in that of the first one, as a matrix (16 numbers) or as a rotation and a translation (9
    and 3). In files of SuperGlue, two numbers after the names say how the photos are turned.

    Args:
      root: folder of the photos.

    Raises:
      UserError: a row or a photo cannot be used.
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--pairs {file}: cannot be read") from error
    images: dict[str, ImageFile] = {}
    pairs = []
    for number, line in enumerate(lines, start=1):
        if not (words := line.split()):
            continue
        where = f"--pairs {file}, row {number}"
        names, values = words[:2], _numbers(words[2:], where)
        for name in names:
            if name not in images:
                images[name] = usable_image(root / name, name=name)
        k0, k1 = (_camera(part, where) for part in np.split(values[:18], 2))
        pose = _pose(values[18:], where)
        pairs.append(PosedPair((images[names[0]], images[names[1]]), (k0, k1), pose))
    if not pairs:
        raise UserError(f"--pairs {file}: no pairs in it")
    return pairs


def _numbers(words: Sequence[str], where: str) -> np.ndarray:
    """The numbers of a row without those that say how its photos are turned."""
    try:
        values = np.asarray([float(word) for word in words])
    except ValueError as error:
        raise UserError(f"{where}: a word that is not a number after the names") from error
    if len(values) == 36:
        if values[:2].any():
            raise UserError(f"{where}: photos that are turned cannot be used")
        values = values[2:]
    if len(values) not in (30, 34) or not np.isfinite(values).all():
        raise UserError(f"{where}: expected two names and 30, 34 or 36 finite numbers")
    return values


def _camera(values: np.ndarray, where: str) -> np.ndarray:
    matrix = values.reshape(3, 3)
    if min(matrix[0, 0], matrix[1, 1]) <= 0 or not np.array_equal(matrix[2], [0, 0, 1]):
        raise UserError(f"{where}: no camera matrix")
    return matrix


def _pose(values: np.ndarray, where: str) -> RelativePose:
    if len(values) == 16:
        matrix = values.reshape(4, 4)
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
    else:
        rotation, translation = values[:9].reshape(3, 3), values[9:]
    right = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and translation.any()
    if not right or np.linalg.det(rotation) < 0:
        raise UserError(f"{where}: no rotation matrix, or no translation")
    return RelativePose(rotation, translation)


def estimated_pose(found: Matches, pair: PosedPair, *, seed: int) -> RelativePose | None:
    """The relative pose that follows from matches; None if there is none."""
    if len(found.xy0) < 5:
        return None
    k0, k1 = pair.cameras
    x0, x1 = (
        (np.c_[xy, np.ones(len(xy))] @ np.linalg.inv(k).T)[:, :2]
        for xy, k in ((found.xy0, k0), (found.xy1, k1))
    )
    focal = float(np.mean([k0[0, 0], k0[1, 1], k1[0, 0], k1[1, 1]]))
    cv2.setRNGSeed(seed)
    essential, inlier = cv2.findEssentialMat(
        x0, x1, np.eye(3), method=cv2.RANSAC, prob=CONFIDENCE, threshold=THRESHOLD_PX / focal
    )
    best, most = None, 0
    for each in () if essential is None else np.split(essential, len(essential) // 3):
        count, rotation, translation, _ = cv2.recoverPose(
            each, x0, x1, np.eye(3), mask=inlier.copy()
        )
        if count > most:
            best, most = RelativePose(rotation, translation.ravel()), count
    return best


def pose_error_deg(found: RelativePose | None, truth: RelativePose) -> float:
    """The larger one of the angles between rotations and between directions of translation.

    The sign of a translation is not counted, as in the source.
    """
    if found is None:
        return np.inf
    cosine = (np.trace(found.rotation @ truth.rotation.T) - 1) / 2
    lengths = np.linalg.norm(found.translation) * np.linalg.norm(truth.translation)
    along = abs(found.translation @ truth.translation) / lengths
    angles = np.degrees(np.arccos(np.clip([cosine, along], -1, 1)))
    return float(angles.max())


def bench_poses(options: PosesOptions) -> BenchFigures[PosesRow, Areas]:
    """Run all methods on all pairs.

    Raises:
      UserError: a photo, the file of the pairs or an option cannot be used.
    """
    methods = options.chosen_methods(PAIR_METHODS)
    check_root(options.root)
    pairs = read_pairs(options.pairs, options.root)[:: options.every]
    return collect("poses", _rows(pairs, methods, options), areas, cells, options)


def _rows(
    pairs: Sequence[PosedPair], methods: Sequence[str], options: PosesOptions
) -> Iterator[PosesRow]:
    matcher = Matcher(options)
    for pair in pairs:
        for method in methods:
            runs = matcher.match(*pair.images, method)
            poses = [estimated_pose(run, pair, seed=seed) for seed, run in enumerate(runs)]
            errors = [pose_error_deg(pose, pair.truth) for pose in poses]
            yield {
                "pair": " ".join(image.name for image in pair.images),
                "method": method,
                "matches": spread(len(run.xy0) for run in runs),
                "errors_deg": [error if np.isfinite(error) else None for error in errors],
                "seconds": float(np.median([run.seconds for run in runs])),
            }


def areas(rows: Sequence[PosesRow]) -> Areas:
    """The areas under the cumulative curves of each method's errors, over all pairs and seeds."""
    errors: dict[str, list[float | None]] = {}
    for row in rows:
        errors.setdefault(row["method"], []).extend(row["errors_deg"])
    return {
        method: {str(limit): area_under_curve(found, limit) for limit in LIMITS_DEG}
        for method, found in errors.items()
    }


def cells(row: PosesRow) -> Cells:
    """A row of the table, with the median error over the seeds."""
    errors = [np.inf if error is None else error for error in row["errors_deg"]]
    return {
        "pair": row["pair"],
        "method": row["method"],
        "matches": f"{row['matches']['mean']:.0f}",
        "error, deg": f"{np.median(errors):.2f}",
        "seconds": f"{row['seconds']:.2f}",
    }


def table_lines(result: BenchFigures[PosesRow, Areas]) -> list[str]:
    """A line for each method."""
    return table(
        [
            {"method": method, **{f"AUC {limit}": f"{area:.3f}" for limit, area in of.items()}}
            for method, of in result["summary"].items()
        ],
        names=1,
    )
