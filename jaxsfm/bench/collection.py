"""`bench collection`: photos of a photo site beside reference poses, which may be rough.

Such a reference has errors of its own, and often comes from another program. So positions are not
compared. A photo of a model is *right* if its rotation is that of the reference, up to the one
rotation between the two worlds that most of the model's photos agree on. Groups that were joined
wrongly are turned against each other, and only one of them is right.

Some photos can be kept out of the models, and added to them by `extend`.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import numpy as np

from jaxsfm.bench.figures import BenchFigures, Cells, collect, table
from jaxsfm.bench.frames import linked
from jaxsfm.bench.model_options import CollectionOptions
from jaxsfm.bench.other_features import OTHERS, presets_and_others, write_other_matches
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import run_mapper
from jaxsfm.colmap.poses import Poses, model_poses, read_model, read_poses
from jaxsfm.config import preset
from jaxsfm.io.pair_selection import natural
from jaxsfm.io.pairs import Pair
from jaxsfm.matching.pipeline import open_images
from jaxsfm.report.verdict import VerdictColour
from jaxsfm.runs.extend import extend_run
from jaxsfm.runs.matching_looks import timed
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import LocalizeOptions, RunOptions
from jaxsfm.sfm.evaluation import pair_names
from jaxsfm.sfm.view_graph import rotation_angle_deg

if TYPE_CHECKING:
    import pycolmap

RIGHT_DEG = 10.0
"""A photo's rotation may be off by so much: the reference of *statue* has one camera for all photos
of a photo site, and repeated sides of a building are 90 or 180 degrees apart."""
NEIGHBOUR_DEG = 5.0
"""The same for the rotation between a camera and the one next to it."""
JUDGED = 3
"""Smaller models are counted and not judged: two photos are nearly always right."""
LARGE = 10
"""Models with so many photos count as models of the collection."""


class ModelFigures(TypedDict):
    """The figures of one model."""

    photos: int
    right: list[str]
    """The names of the right photos, sorted."""
    pairs_right: float
    """The share of the pairs of its cameras whose rotation is right (`RIGHT_DEG`)."""
    neighbours_right: float
    """The share of its cameras that are right beside the nearest one (`NEIGHBOUR_DEG`)."""
    points: int
    error_px: float
    """The mean reprojection error, original pixels."""


class ExtensionFigures(TypedDict):
    """What became of the photos that were kept out and then added."""

    photos: int
    placed: int
    right: list[str]
    """The names of the right ones, sorted; without a reference pose, a photo is not right."""
    seconds: float


class Made(NamedTuple):
    """What a method made of a collection."""

    models: "list[pycolmap.Reconstruction]"
    """The one with most photos first."""
    seconds: dict[str, float]
    verdict: VerdictColour | None
    extension: ExtensionFigures | None = None


class CollectionRow(TypedDict):
    """The figures of one method."""

    method: str
    photos: int
    """Those of the collection, with and without a reference pose."""
    registered: int
    """Photos in any model."""
    models: list[ModelFigures]
    """Those with `JUDGED` photos with a reference pose or more, the largest first."""
    small_models: int
    """The number of the other models."""
    right_in_large: int
    """Different photos that are right in a model of `LARGE` photos or more."""
    verdict: VerdictColour | None
    """None: the method gives none."""
    seconds: dict[str, float]
    extension: ExtensionFigures | None
    """None: no photo was kept out, or the method cannot add photos to a model."""


def differences(model: Poses, truth: Poses) -> tuple[list[str], np.ndarray]:
    """How far photos disagree on the rotation between the two worlds.

    Returns:
      the photos of the model that have a reference pose, sorted; float64 (n, n), for each two of
      them the angle between the rotations that they say, degrees.
    """
    names = pair_names(model, truth)
    ours = sorted(names)
    said = [model[name].rotation.T @ truth[names[name]].rotation for name in ours]
    between = np.asarray(said).reshape(-1, 3, 3)
    return ours, rotation_angle_deg(between[:, None], between[None])


def right_photos(names: list[str], off: np.ndarray) -> list[str]:
    """The right ones of some photos, in their order. Arguments are what `differences` returns.

    The rotation between the two worlds is that of the photo that most photos agree with; of equal
    ones, the first.
    """
    if not names:
        return []
    agree = off < RIGHT_DEG
    return [name for name, right in zip(names, agree[agree.sum(1).argmax()], strict=True) if right]


def model_figures(model: "pycolmap.Reconstruction", truth: Poses) -> ModelFigures:
    """Judge a model of three photos or more."""
    poses = model_poses(model)
    ours, off = differences(poses, truth)
    centres = np.stack([poses[name].centre for name in ours])
    far = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(far, math.inf)
    return {
        "photos": len(poses),
        "right": right_photos(ours, off),
        "pairs_right": float((off < RIGHT_DEG)[np.triu_indices(len(ours), 1)].mean()),
        "neighbours_right": float(
            (off[np.arange(len(ours)), far.argmin(1)] < NEIGHBOUR_DEG).mean()
        ),
        "points": len(model.points3D),
        "error_px": float(model.compute_mean_reprojection_error()),
    }


def _row(method: str, photos: int, made: Made, truth: Poses) -> CollectionRow:
    poses = [model_poses(model) for model in made.models]
    judged = [
        model_figures(model, truth)
        for model, placed in zip(made.models, poses, strict=True)
        if len(pair_names(placed, truth)) >= JUDGED
    ]
    return {
        "method": method,
        "photos": photos,
        "registered": len(set().union(*poses)),
        "models": judged,
        "small_models": len(made.models) - len(judged),
        "right_in_large": len({n for m in judged if m["photos"] >= LARGE for n in m["right"]}),
        "verdict": made.verdict,
        "seconds": made.seconds,
        "extension": made.extension,
    }


def _extended(work: Path, every: Path, added: set[str], truth: Poses) -> ExtensionFigures:
    """Add photos to the models of a run, and judge each in its model.

    Args:
      every: a folder of the run's photos and the added ones.
    """
    seconds: dict[str, float] = {}
    with timed(seconds, "extension"):
        report = extend_run(work, options=LocalizeOptions(images=every, progress=True))
    assert report is not None
    models = [model_poses(read_model(work / "sparse" / str(k))) for k in range(len(report.models))]
    right = {name for poses in models for name in right_photos(*differences(poses, truth))}
    return {
        "photos": len(added),
        "placed": len(set().union(*models) & added),
        "right": sorted(right & added),
        "seconds": seconds["extension"],
    }


def _rows(options: CollectionOptions, methods: list[str], truth: Poses) -> Iterator[CollectionRow]:
    """A row for each method; presets come first, because they choose the pairs."""
    pairs: set[Pair] = set()
    folder, out, added = options.root, options.out, set[str]()
    names = sorted((image.name for image in open_images(folder)[0]), key=natural)
    if options.extend:
        added = {*names[options.extend // 2 :: options.extend]}
        out = options.out / f"extend-{options.extend}"
        folder = linked(options.root, [n for n in names if n not in added], out / "photos")
    for method in methods:
        work = out / method
        if method in OTHERS:
            database = work / "database.db"
            seconds = write_other_matches(database, folder, method, pairs, Cameras())
            with timed(seconds, "mapping"):
                models = run_mapper(database, MapOptions(refine_intrinsics=True))
            made = Made(models, seconds, None)
        else:
            given = RunOptions(pairs=options.pairs, keep_features=bool(added), progress=True)
            report = reconstruct_folder(folder, work, config=preset(method), options=given)
            pairs = {each.pair for each in report.pairs.each}
            models = [read_model(work / "sparse" / str(k)) for k in range(len(report.models))]
            made = Made(models, dict(report.seconds), report.verdict)
            if added and models:
                made = made._replace(extension=_extended(work, options.root, added, truth))
        yield _row(method, len(names) - len(added), made, truth)


def bench_collection(options: CollectionOptions) -> BenchFigures[CollectionRow, dict[str, int]]:
    """Make models of a collection, and judge each of them.

    Raises:
      UserError: a photo, a pose or an option cannot be used.
    """
    methods = presets_and_others(options)
    truth = read_poses(options.reference or options.root)
    return collect("collection", _rows(options, methods, truth), summary, cells, options)


def summary(rows: list[CollectionRow]) -> dict[str, int]:
    """How many photos each method has placed rightly in large models."""
    return {row["method"]: row["right_in_large"] for row in rows}


def cells(row: CollectionRow) -> Cells:
    """A row of the table: all large models, and the figures of the largest."""
    large = [m for m in row["models"] if m["photos"] >= LARGE]
    found: Cells = {
        "method": row["method"],
        "registered": f"{row['registered']} of {row['photos']}",
        "right": str(row["right_in_large"]),
        "models": ", ".join(f"{len(m['right'])} of {m['photos']}" for m in large),
        "smaller": str(len(row["models"]) - len(large) + row["small_models"]),
    }
    if row["models"]:
        first = row["models"][0]
        found |= {
            "pairs": f"{100 * first['pairs_right']:.1f}%",
            "neighbours": f"{100 * first['neighbours_right']:.1f}%",
            "points": str(first["points"]),
            "error px": f"{first['error_px']:.2f}",
        }
    if extended := row["extension"]:
        found["added"] = (
            f"{len(extended['right'])} of {extended['placed']} of {extended['photos']}, "
            f"{extended['seconds']:.0f} s"
        )
    return found | {
        "verdict": row["verdict"] or "",
        "seconds": f"{sum(row['seconds'].values()):.0f}",
    }


def table_lines(result: BenchFigures[CollectionRow, dict[str, int]]) -> list[str]:
    """All rows, and what the columns are."""
    return [
        *table([cells(row) for row in result["rows"]], names=1),
        "",
        f"right: photos of models of {LARGE} and more that are turned as in the reference, within "
        f"{RIGHT_DEG:g} deg. models: right photos of all, of each such model.",
        "pairs, neighbours: of the largest model, the pairs of cameras that are turned rightly "
        f"within {RIGHT_DEG:g} deg, and the cameras that are so beside the nearest one, within "
        f"{NEIGHBOUR_DEG:g} deg.",
        "added: with --extend, the right ones of the placed ones of the photos that were kept out.",
    ]
