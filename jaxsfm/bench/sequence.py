"""Frames of a video with reference poses: models of some of them, and the others localized.

Models are made with jaxsfm, and with RootSIFT or ALIKED and LightGlue in COLMAP, on the same pairs
and with the same camera. The figures are those of a run: seconds of each stage, the number of
registered frames, the position errors after a similarity over all frames, and those of the first
and the last tenth of the frames (drift).
"""

import dataclasses
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxsfm.bench.figures import write_json
from jaxsfm.bench.inputs import Frames, chosen_frames, linked
from jaxsfm.bench.methods import LIGHTGLUE, ROOTSIFT
from jaxsfm.bench.model_options import CameraUse, SequenceOptions
from jaxsfm.bench.options import BenchOptions, whole_numbers
from jaxsfm.bench.other_methods import trained_networks, write_other_matches
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import read_images
from jaxsfm.colmap.given_cameras import parse_cameras
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import run_mapper
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import Poses, model_poses, read_poses
from jaxsfm.colmap.resection import find_view
from jaxsfm.colmap.two_views import read_inliers
from jaxsfm.colmap.view import View
from jaxsfm.config import PRESETS, preset
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.pair_selection import natural
from jaxsfm.io.pairs import Pair, make_pair
from jaxsfm.io.photos import Pixels
from jaxsfm.options import Mapper
from jaxsfm.runs.job import timed
from jaxsfm.runs.localize import localize_photos
from jaxsfm.runs.localize_report import LocalizedPhoto
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import LocalizeOptions, RunOptions
from jaxsfm.sfm.evaluation import (
    PoseError,
    common_alignment,
    evaluate,
    own_rotation_deg,
    pose_error,
)

if TYPE_CHECKING:
    import pycolmap

OTHERS = (ROOTSIFT, LIGHTGLUE)
"""The methods that get the pairs of a preset."""
END = 0.1
"""The share of the frames at either end whose errors are reported apart."""
NEAR, NEAR_DEG = 0.05, 5.0
"""A localized frame counts as right within this distance (units of the poses) and this angle: the
limits of 7-Scenes (Shotton et al. 2013)."""
MATCH_ERROR_PX = 12.0
"""Of a match of RootSIFT with a point: the limit of COLMAP's mapper."""


class FrameSequence(NamedTuple):
    """The input of all methods."""

    folder: Path
    """Of the frames and their poses."""
    frames: Frames
    work: Path
    """Where results are kept."""
    camera: CameraUse
    """What is done with the camera of the folder."""
    mapper: Mapper
    """Of the presets."""
    truth: Poses

    @property
    def intrinsics(self) -> str | None:
        """The value of `--intrinsics`; None: the camera is not known."""
        return None if self.camera == "unknown" else str(self.folder / "K.txt")

    @property
    def held(self) -> str | None:
        """The value of `--intrinsics` for photos whose camera is not adjusted."""
        return self.intrinsics if self.camera == "known" else None


def errors(model: Poses, truth: Poses) -> dict[str, Json]:
    """Position errors of a model after the best similarity, and those of its ends."""
    found = evaluate(model, truth)
    names = sorted(found.images, key=natural)
    count = max(1, round(END * len(names)))
    ends = [names[:count], names[-count:]]
    return {
        "registered": len(names),
        "position": found.position["mean"],
        "rotation_deg": found.rotation_deg["mean"],
        "own_rotation_deg": own_rotation_deg(model, truth),
        "ends": [float(np.mean([found.images[n].position for n in end])) for end in ends],
    }


def _summary(found: Mapping[str, PoseError], frames: int, seconds: float) -> dict[str, Json]:
    """What became of localized frames; those without a pose have no error."""
    each = list(found.values())
    near = [e for e in each if e.position < NEAR and e.rotation_deg < NEAR_DEG]
    return {
        "frames": frames,
        "placed": len(each),
        "near": len(near),
        "median_position": float(np.median([e.position for e in each])) if each else None,
        "median_rotation_deg": float(np.median([e.rotation_deg for e in each])) if each else None,
        "seconds": seconds,
        "each": {name: dataclasses.asdict(error) for name, error in sorted(found.items())},
    }


def with_jaxsfm(given: FrameSequence, name: str) -> tuple[dict[str, Json], set[Pair]]:
    """Models of a preset, and localized frames; the pairs that were tried, for other methods."""
    out = given.work / name
    report = reconstruct_folder(
        linked(given.folder, [f.name for f in given.frames.mapped], given.work / "frames"),
        out,
        config=preset(name),
        options=RunOptions(
            intrinsics=given.intrinsics,
            refine_intrinsics="no" if given.held else "yes",
            mapper=given.mapper,
            keep_features=True,
            progress=True,
        ),
    )
    row: dict[str, Json] = {
        "verdict": report.verdict,
        "seconds": dict(report.seconds),
        **errors(model_poses(read_model(out / "sparse" / "0")), given.truth),
    }
    pairs = {each.pair for each in report.pairs.each}
    if given.frames.localized:
        start = time.monotonic()
        options = LocalizeOptions(
            intrinsics=given.held, reference=given.folder, keep_features=True, progress=True
        )
        found = localize_photos(given.frames.localized, out, options=options).photos
        seconds = time.monotonic() - start
        placed = {}
        for each in found:
            photo = Path(each.photo).name
            pairs |= {make_pair(photo, other) for other in each.shortlist or ()}
            if isinstance(each, LocalizedPhoto) and each.error is not None:
                placed[photo] = each.error
        row["localized"] = _summary(placed, len(found), seconds)
        row["trusted"] = sum(each.status == "localized" for each in found)
    return row, pairs


def with_other_features(given: FrameSequence, method: str, pairs: set[Pair]) -> dict[str, Json]:
    """The same of `OTHERS` on given pairs: a model of COLMAP's incremental mapper, and frames
    localized by the matches with points of the model."""
    database = given.work / method / "database.db"
    every = [frame.name for frame in (*given.frames.mapped, *given.frames.localized)]
    folder = linked(given.folder, every, given.work / "all")
    cameras = Cameras(known=parse_cameras(given.intrinsics) if given.intrinsics else None)
    seconds = write_other_matches(database, folder, method, pairs, cameras)
    names = [frame.name for frame in given.frames.mapped]
    options = MapOptions(refine_intrinsics=given.held is None)
    with timed(seconds, "mapping"):
        models = run_mapper(database, options, names=names)
    row: dict[str, Json] = {
        "seconds": dict(seconds),
        **errors(model_poses(models[0]), given.truth),
    }
    if given.frames.localized:
        start = time.monotonic()
        placed = _placed_by_matches(given, database, models[0])
        row["localized"] = _summary(placed, len(given.frames.localized), time.monotonic() - start)
    return row


def _placed_by_matches(
    given: FrameSequence, database: Path, model: "pycolmap.Reconstruction"
) -> dict[str, PoseError]:
    """The errors of frames whose pose follows from their matches with the model's keypoints."""
    inliers, cameras = read_inliers(database), read_images(database)
    point_of = {
        model.image(k).name: {
            i: model.point3D(p.point3D_id).xyz
            for i, p in enumerate(model.image(k).points2D)
            if p.has_point3D()
        }
        for k in model.reg_image_ids()
    }
    _, _, to_truth = common_alignment(model_poses(model), given.truth)
    found = {}
    for frame in given.frames.localized:
        xy, points = [], []
        for (a, b), rows in inliers.matches.items():
            if frame.name not in (a, b):
                continue
            other, side = (b, 0) if a == frame.name else (a, 1)
            known = point_of.get(other, {})
            for row in rows:
                if int(row[1 - side]) in known:
                    xy.append(inliers.keypoints[frame.name].xy[row[side]])
                    points.append(known[int(row[1 - side])])
        number, camera = cameras[frame.name]
        size = (camera.width, camera.height)
        view = View.without_pose(frame.name, number, camera, size, Pixels((1.0, 1.0)))
        at = find_view(
            view,
            np.asarray(xy).reshape(-1, 2),
            np.asarray(points).reshape(-1, 3),
            max_error_px=MATCH_ERROR_PX,
            estimate_focal_length=False,
            seed=0,
        )
        if at is not None:
            pose = to_truth.moved(at.pose)
            found[frame.name] = pose_error(pose, given.truth[frame.stem])
    return found


def presets_and_others(options: BenchOptions) -> list[str]:
    """The chosen methods, presets and `OTHERS`; presets come first, because they choose the pairs.

    Raises:
      UserError: a method is unknown, there is no preset, or a package is missing.
    """
    methods = options.chosen_methods([*PRESETS, *OTHERS])
    if methods[0] in OTHERS:
        raise UserError(
            f"--methods: {methods[0]} needs a preset beside it, which chooses the pairs"
        )
    if LIGHTGLUE in methods:
        trained_networks()  # say at once what is missing
    return methods


def _measured(given: FrameSequence, methods: list[str]) -> Iterator[dict[str, Json]]:
    """A row for each method; presets come first, because they choose the pairs."""
    pairs: set[Pair] = set()
    for method in methods:
        if method in OTHERS:
            row = with_other_features(given, method, pairs)
        else:
            row, pairs = with_jaxsfm(given, method)
        frames = len(given.frames.mapped)
        yield {"method": method, "frames": frames, "camera": given.camera, **row}


def bench_sequence(options: SequenceOptions) -> dict[str, Json]:
    """Measure some numbers of frames.

    Raises:
      UserError: a frame, a pose or an option cannot be used.
    """
    methods = presets_and_others(options)
    truth = read_poses(options.root)
    rows: list[dict[str, Json]] = []
    for every in whole_numbers(options.every, "--every"):
        frames = chosen_frames(options.root, every, options.localize)
        parts = [f"every-{every}", *_others(options)]
        work = options.out / "-".join(filter(None, parts))
        for row in _measured(
            FrameSequence(options.root, frames, work, options.intrinsics, options.mapper, truth),
            methods,
        ):
            rows.append(row)
            if options.json:
                write_json(options.json, {"rows": rows})
    return {"rows": rows}


def _others(options: SequenceOptions) -> list[str]:
    """What else a folder of results is named after."""
    camera = "" if options.intrinsics == "known" else options.intrinsics
    mapper = "" if options.mapper == "incremental" else options.mapper
    return [camera, mapper, f"localize-{options.localize}" if options.localize else ""]


def table_lines(figures: Mapping[str, Json]) -> list[str]:
    """A line for each method and number of frames, and one for localized frames."""
    rows: Any = figures["rows"]
    lines = ["frames  camera   method            registered  position  first, last tenth  seconds"]
    for row in rows:
        ends = ", ".join(f"{end:.4f}" for end in row["ends"])
        stages = ", ".join(f"{name} {value:.0f}" for name, value in row["seconds"].items())
        lines.append(
            f"{row['frames']:<7} {row['camera']:<8} {row['method']:<17} {row['registered']:>10}  "
            f"{row['position']:>8.4f}  {ends:<17}  {sum(row['seconds'].values()):.0f} ({stages})"
        )
        if found := row.get("localized"):
            medians = "none has a pose"
            if found["placed"]:
                medians = (
                    f"median {found['median_position']:.4f}, {found['median_rotation_deg']:.2f} deg"
                )
            lines.append(
                f"        localized: {found['near']} of {found['frames']} within {NEAR:g} and "
                f"{NEAR_DEG:g} deg, {found['placed']} placed, {medians}, {found['seconds']:.0f} s"
            )
    return lines
