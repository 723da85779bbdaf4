"""`bench strecha`: the paper's comparison on standard scenes (Strecha et al., CVPR 2008)."""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from jaxsfm.bench.figures import BenchFigures, Cells, collect, forget_peak, peak_bytes, table
from jaxsfm.bench.inputs import StrechaSet, read_sets
from jaxsfm.bench.methods import SET_METHODS
from jaxsfm.bench.model_options import StrechaOptions
from jaxsfm.bench.strecha_models import MethodRun, SetModels, set_models
from jaxsfm.colmap.poses import Poses, model_poses
from jaxsfm.errors import UserError
from jaxsfm.sfm.evaluation import evaluate, own_rotation_deg

if TYPE_CHECKING:
    import pycolmap

BASELINE = "rootsift"
"""The method that the others are compared with."""
STAGES = ("extraction", "matching", "mapping", "refinement")
"""The stages whose seconds are shown."""
PUBLISHED = {"DoG + RootSIFT": (0.17, 0.90), "dense + relocalization": (0.59, 2.27)}
"""What the paper reports (Widya et al. 2018): the means over its six sets, in full size, of the
mean position errors (metres) and of the mean rotation errors (degrees)."""


class ModelFigures(TypedDict):
    """The figures of the largest model."""

    points: int
    observations: int
    track_length: float
    reprojection_error_px: float
    focal_error_percent: float
    """The largest error of a focal length."""


class CameraErrors(TypedDict):
    """How far the cameras of a model are from the reference, after the best similarity."""

    position: dict[str, float] | None
    """Mean, median and largest position error, units of the reference."""
    rotation_deg: dict[str, float] | None
    not_evaluated: str
    """Why there are no errors; empty if there are."""


class ModelRow(CameraErrors):
    """The figures that benchmarks of models have for each set and method."""

    set: str
    method: str
    images: int
    """The number of reference poses."""
    stages: dict[str, float]
    """Seconds of each stage. COLMAP's own extraction is part of its matching."""


class StrechaRow(ModelRow):
    """The figures of one set and one method."""

    registered: int
    own_rotation_deg: float | None
    """The mean rotation error after the rotations alone were aligned; None without a model."""
    model: ModelFigures | None
    peak_bytes: int | None
    """The most memory that the process held; None where the system does not say."""


Ratios = dict[str, dict[str, dict[str, float]]]
"""Figures divided by those of the baseline, by method and set; "mean" is the mean of the sets."""


class MeanErrors(TypedDict):
    """The means over sets of a method's mean errors."""

    sets: int
    """The number of sets whose models were evaluated."""
    position: float
    rotation_deg: float


class StrechaSummary(TypedDict):
    """The figures over all sets."""

    means: dict[str, MeanErrors]
    """By method."""
    ratios: Ratios


def camera_errors(model: Poses | None, truth: Poses) -> CameraErrors:
    """The errors of a model's cameras; None stands for no model."""
    failed: CameraErrors = {"position": None, "rotation_deg": None, "not_evaluated": "no model"}
    if model is None:
        return failed
    try:
        errors = evaluate(model, truth)
    except UserError as error:
        return {**failed, "not_evaluated": str(error)}
    return {"position": errors.position, "rotation_deg": errors.rotation_deg, "not_evaluated": ""}


def _row(each: StrechaSet, method: str, made: SetModels, peak: int | None) -> StrechaRow:
    """The figures of the largest model; `peak` is `peak_bytes`."""
    model = made.models[0] if made.models else None
    return {
        "set": each.folder.name,
        "method": method,
        "images": len(each.truth),
        "registered": model.num_reg_images() if model else 0,
        "own_rotation_deg": own_rotation_deg(model_poses(model), each.truth) if model else None,
        "stages": made.seconds,
        "peak_bytes": peak,
        "model": _model_figures(model, each.focal) if model else None,
        **camera_errors(model_poses(model) if model else None, each.truth),
    }


def _model_figures(model: "pycolmap.Reconstruction", focal: float) -> ModelFigures:
    focals = [
        model.cameras[model.image(i).camera_id].mean_focal_length() for i in model.reg_image_ids()
    ]
    return {
        "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "track_length": model.compute_mean_track_length(),
        "reprojection_error_px": model.compute_mean_reprojection_error(),
        "focal_error_percent": 100 * max(abs(own / focal - 1) for own in focals),
    }


def bench_strecha(options: StrechaOptions) -> BenchFigures[StrechaRow, StrechaSummary]:
    """Run all methods on all sets, with the same images, camera, verification and mapper."""
    methods = options.chosen_methods(SET_METHODS)
    # All inputs are read before the first reconstruction, which takes minutes.
    sets = read_sets(options.root, options.chosen_sets())

    def rows() -> Iterator[StrechaRow]:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            for each in sets:
                for method in methods:
                    work = (options.out or Path(scratch)) / each.folder.name / method
                    run = MethodRun(
                        method=method,
                        known=options.intrinsics == "known",
                        network=options.network,
                        seed=options.seed,
                        threads=options.threads,
                        best_pairs=options.best_pairs,
                    )
                    forget_peak()
                    made = set_models(each, work, run)
                    yield _row(each, method, made, peak_bytes())

    def summary(measured: list[StrechaRow]) -> StrechaSummary:
        return {"means": means(measured), "ratios": ratios(measured)}

    return collect("strecha", rows(), summary, cells, options)


def means(rows: Sequence[StrechaRow]) -> dict[str, MeanErrors]:
    """The paper's figures: the means over the sets of the mean errors, by method."""
    found: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if row["position"] is not None and row["rotation_deg"] is not None:
            each = row["position"]["mean"], row["rotation_deg"]["mean"]
            found.setdefault(row["method"], []).append(each)
    return {
        method: {
            "sets": len(errors),
            "position": float(np.mean([position for position, _ in errors])),
            "rotation_deg": float(np.mean([rotation for _, rotation in errors])),
        }
        for method, errors in found.items()
    }


def ratios(rows: Sequence[StrechaRow]) -> Ratios:
    """Each method's figures divided by the baseline's, by set and as the mean of the sets."""
    figures = {(row["method"], row["set"]): of for row in rows if (of := _compared(row))}
    result: Ratios = {}
    for (method, name), own in figures.items():
        base = figures.get((BASELINE, name))
        if method != BASELINE and base is not None:
            result.setdefault(method, {})[name] = {key: own[key] / base[key] for key in own}
    for sets in result.values():
        each = list(sets.values())
        sets["mean"] = {key: float(np.mean([of[key] for of in each])) for key in each[0]}
    return result


def _compared(row: StrechaRow) -> dict[str, float] | None:
    """The figures of which ratios are taken; None if the model was not evaluated."""
    if row["model"] is None or row["position"] is None or row["rotation_deg"] is None:
        return None
    return {
        "position": row["position"]["mean"],
        "rotation": row["rotation_deg"]["mean"],
        "points": row["model"]["points"],
        "reprojection error": row["model"]["reprojection_error_px"],
        "seconds": sum(row["stages"].values()),
    }


def cells(row: StrechaRow) -> Cells:
    """A row of the table: mean errors in units of the reference and in degrees."""
    found = {
        "set": row["set"],
        "method": row["method"],
        "images": f"{row['registered']}/{row['images']}",
    }
    if row["position"] is not None and row["rotation_deg"] is not None:
        found["position"] = f"{row['position']['mean']:.4f}"
        found["rotation"] = f"{row['rotation_deg']['mean']:.4f}"
    if row["own_rotation_deg"] is not None:
        found["own rotation"] = f"{row['own_rotation_deg']:.4f}"
    if (model := row["model"]) is not None:
        found["points"] = str(model["points"])
        found["observations"] = str(model["observations"])
        found["track"] = f"{model['track_length']:.2f}"
        found["reprojection"] = f"{model['reprojection_error_px']:.3f}"
        found["focal"] = f"{model['focal_error_percent']:.2f}%"
    found |= {stage: f"{row['stages'].get(stage, 0.0):.1f}" for stage in STAGES}
    if row["peak_bytes"] is not None:
        found["GB"] = f"{row['peak_bytes'] / 1e9:.2f}"
    return found | {"seconds": f"{sum(row['stages'].values()):.1f}"}


def not_evaluated_lines(rows: Sequence[ModelRow]) -> list[str]:
    """Why models have no errors, a line for each of them."""
    return [
        f"{row['set']} {row['method']}: {row['not_evaluated']}"
        for row in rows
        if row["not_evaluated"]
    ]


def table_lines(result: BenchFigures[StrechaRow, StrechaSummary]) -> list[str]:
    """The paper's table with the paper's own rows, and the ratios to RootSIFT."""
    ours = [
        (f"mean, sets: {mean['sets']}", method, mean["position"], mean["rotation_deg"])
        for method, mean in result["summary"]["means"].items()
    ]
    theirs = [("published, sets: 6", method, *errors) for method, errors in PUBLISHED.items()]
    averages = [
        {"set": name, "method": method, "position": f"{position:.4f}", "rotation": f"{turn:.4f}"}
        for name, method, position, turn in [*ours, *theirs]
    ]
    lines = table([*map(cells, result["rows"]), *averages])
    lines += not_evaluated_lines(result["rows"])
    for method, sets in result["summary"]["ratios"].items():
        mean = ", ".join(f"{key} {value:.2f}" for key, value in sets["mean"].items())
        lines.append(f"{method} / {BASELINE} (sets: {len(sets) - 1}): {mean}")
    return lines
