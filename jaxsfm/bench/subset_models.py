"""Reconstruct the subsets of a day and night scene by a method, and count right night matches."""

import dataclasses
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.bench.inputs import linked
from jaxsfm.bench.methods import NAIVE, method_config
from jaxsfm.bench.model_options import DayNightOptions
from jaxsfm.bench.other_methods import match_pairs_naively
from jaxsfm.bench.scenes import Scene, Subset
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import drop_pairs, read_matches
from jaxsfm.colmap.given_cameras import write_camera_list
from jaxsfm.colmap.intrinsics import camera_of
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import build_models
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import CameraPose, Poses, model_poses
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions, rays_of, read_two_views
from jaxsfm.errors import UserError
from jaxsfm.io.entries import RECORD
from jaxsfm.io.pairs import Pair, PairResult, exhaustive_pairs
from jaxsfm.io.weights import chosen_weights
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.mapped_stage import DATABASE
from jaxsfm.sfm.road import reconstruct

if TYPE_CHECKING:
    import pycolmap

FEATURES = 64
"""Photos whose features are kept for the next subset (at least those of one): 25 MB each at 1536 x
1024."""
KEPT = ("features", "matches")
"""The folders of a run that the next one can use."""
CORRECT_PX = 4.0
"""The largest distance of a right match from the true epipolar line. In images of 1000 px height a
wrong match lies that close by chance in 1 of 100 cases."""


class NightMatches(NamedTuple):
    """The number of a night photo's verified matches, and how many of them are right."""

    number: int
    correct: int


def epipolar_distance(
    rays0: np.ndarray, rays1: np.ndarray, pose0: CameraPose, pose1: CameraPose
) -> np.ndarray:
    """The distance of each point in image 1 from the epipolar line of its partner in image 0.

    The unit is the focal length of image 1. The distance is nan for a ray in the image plane.

    Args:
      rays0, rays1: (n, 3), rays in the frames of the two cameras.

    Source: Hartley and Zisserman, 2nd edition, section 9.6 (x1' E x0 = 0, E = [t]x R).
    """
    rotation = pose1.rotation @ pose0.rotation.T
    t = pose1.rotation @ (pose0.centre - pose1.centre)
    line = np.cross(t, rays0 @ rotation.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = rays1 / rays1[:, 2:]
        return np.abs((line * at).sum(1)) / np.linalg.norm(line[:, :2], axis=1)


def night_matches(database: Path, scene: Scene, subset: Subset) -> NightMatches | None:
    """Count the verified matches of a subset's night photo in a COLMAP database.

    Matches with all day photos that have a reference pose are counted. The result is None if the
    camera or the night photo's pose is unknown.
    """
    if scene.camera is None or subset.night not in scene.truth:
        return None

    def camera(name: str) -> "pycolmap.Camera":
        assert scene.camera is not None
        return camera_of(scene.camera, scene.images[name]).camera(scene.images[name].size)

    night = camera(subset.night)
    number = correct = 0
    for name in subset.day:
        if name not in scene.truth:
            continue
        xy0, xy1 = read_matches(database, (name, subset.night), verified=True)
        if not len(xy0):
            continue
        far = night.mean_focal_length() * epipolar_distance(
            rays_of(camera(name), xy0),
            rays_of(night, xy1),
            scene.truth[name],
            scene.truth[subset.night],
        )
        number += len(far)
        correct += int((far <= CORRECT_PX).sum())
    return NightMatches(number, correct)


class SubsetModel(NamedTuple):
    """A method's reconstruction of one subset."""

    poses: Poses
    """The poses of the largest model."""
    matches: NightMatches | None


def _map_options(scene: Scene, options: DayNightOptions) -> MapOptions:
    return MapOptions(
        refine_intrinsics=scene.camera is None, seed=options.seed, threads=options.threads
    )


def rootsift_models(scene: Scene, scratch: Path, options: DayNightOptions) -> list[SubsetModel]:
    """A model of each subset from COLMAP's own features.

    Features and matches of all photos are computed once; each subset takes its part of them.
    """
    database = scratch / "all.db"
    images = [scene.images[name] for name in sorted(scene.images)]
    blanks = any(" " in name for name in scene.images)  # COLMAP's pair lists cannot hold them
    pairs = {p for subset in scene.subsets for p in exhaustive_pairs([*subset.day, subset.night])}
    write_rootsift_database(
        database,
        scene.folder,
        images,
        Cameras(known=scene.camera),
        VerificationOptions(seed=options.seed, threads=options.threads),
        pairs=None if blanks else sorted(pairs),
    )
    every = read_two_views(database)
    models = []
    for subset in scene.subsets:
        part = scratch / "part.db"
        shutil.copyfile(database, part)
        names = {*subset.day, subset.night}
        kept = {pair: view for pair, view in every.items() if names.issuperset(pair)}
        drop_pairs(part, every.keys() - kept.keys())
        found = build_models(part, kept, _map_options(scene, options))
        poses = model_poses(found[0]) if found else {}
        models.append(SubsetModel(poses, night_matches(part, scene, subset)))
    return models


def dense_models(
    scene: Scene, scratch: Path, method: str, options: DayNightOptions
) -> list[SubsetModel]:
    """A model of each subset by a run of ours, as `jaxsfm reconstruct` makes it.

    A run takes over the features and matches of the subset before, if they have photos in common.

    Raises:
      UserError: a photo cannot be used.
    """
    given = RunOptions(
        pairs="exhaustive",  # as RootSIFT
        intrinsics=_written_cameras(scene, scratch / "cameras.txt"),
        network=options.network,
        seed=options.seed,
        threads=options.threads,
        keep_features=True,
        progress=True,
    )
    work, photos = scratch / method, scratch / f"{method}-photos"
    models, before = [], set[str]()
    for subset in scene.subsets:
        names = {*subset.day, subset.night}
        if len(before) <= FEATURES and not names.isdisjoint(before):
            forget_results(work)
        else:
            shutil.rmtree(work, ignore_errors=True)
        before = names if not work.exists() else before | names
        report = reconstruct_folder(
            linked(scene.folder, names, photos), work, config=method_config(method), options=given
        )
        if skipped := report.images.skipped:
            raise UserError(f"--root: {next(iter(skipped.values()))}")
        poses = model_poses(read_model(work / "sparse" / "0")) if report.models else {}
        models.append(SubsetModel(poses, night_matches(work / DATABASE, scene, subset)))
    shutil.rmtree(work)
    return models


def forget_results(work: Path) -> None:
    """Leave nothing of a run but its features and matches."""
    for path in work.iterdir():
        if path.is_dir() and path.name not in KEPT:
            shutil.rmtree(path)
        elif path.is_file() and path.name != RECORD:
            path.unlink()


def _written_cameras(scene: Scene, path: Path) -> str | None:
    """The value of `--intrinsics`: a list of the scene's cameras; None if they are not known."""
    if scene.camera is None:
        return None
    known = {
        name: dataclasses.replace(camera_of(scene.camera, image), size=image.size)
        for name, image in scene.images.items()
    }
    write_camera_list(path, known)
    return str(path)


def naive_models(scene: Scene, scratch: Path, options: DayNightOptions) -> list[SubsetModel]:
    """A model of each subset from matches of pixels. A pair's matches are computed once."""
    config = method_config(NAIVE)
    weights = chosen_weights(options.network, config.backbone)
    last_use = {
        pair: k
        for k, subset in enumerate(scene.subsets)
        for pair in exhaustive_pairs([*subset.day, subset.night])
    }
    results: dict[Pair, PairResult] = {}
    models = []
    for k, subset in enumerate(scene.subsets):
        pairs = exhaustive_pairs([*subset.day, subset.night])
        missing = [pair for pair in pairs if pair not in results]
        for result in match_pairs_naively(
            weights, scene.images, missing, config=config, seed=options.seed
        ):
            results[result.pair] = result
        made = reconstruct(
            [scene.images[name] for name in sorted({*subset.day, subset.night})],
            {pair: results[pair] for pair in pairs},
            scratch / "part.db",
            config=config,
            cameras=Cameras(known=scene.camera),
            options=_map_options(scene, options),
        )
        poses = model_poses(made.models[0]) if made.models else {}
        models.append(SubsetModel(poses, night_matches(scratch / "part.db", scene, subset)))
        results = {pair: result for pair, result in results.items() if last_use[pair] > k}
    return models
