"""The stages composed: extract -> match -> reconstruct; the only module that runs core and host.

Every stage is a function of its inputs and a config. `jaxsfm.run_folder` strings them together in a
work folder.
"""

import dataclasses
import functools
import logging
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np
from tqdm import tqdm

from jaxsfm.config import Config, Refinement
from jaxsfm.core.grid import rescale
from jaxsfm.core.pair import match_pair, pair_key
from jaxsfm.core.types import PairMatches, Status, Thresholds
from jaxsfm.errors import UserError
from jaxsfm.host.features import ImageFeatures, image_features, pad_features
from jaxsfm.host.images import (
    ImageError,
    ImageFile,
    find_images,
    inspect_image,
    read_image,
    working_size,
)
from jaxsfm.host.pairs import Pair, PairResult, make_pair
from jaxsfm.host.viewgraph import Verdict, trusted_pairs
from jaxsfm.host.weights import Weights
from jaxsfm.patches import gray

if TYPE_CHECKING:
    import pycolmap

    from jaxsfm.host.intrinsics import Intrinsics
    from jaxsfm.host.mapping import Attempt, MapOptions
    from jaxsfm.refine import RefinementFigures

GRAYS = 64
"""Decoded images kept during refinement: 8 MB each at 1600 x 1200."""
logger = logging.getLogger("jaxsfm")


def open_images(folder: Path, *, progress: bool = False) -> tuple[list[ImageFile], dict[str, str]]:
    """The usable images below a folder, and why each of the others is not.

    Raises:
      UserError: no such folder, or no image files in it.
    """
    images, lost = [], {}
    names = find_images(folder)
    for name in tqdm(names, desc="reading", unit="image", delay=2, disable=not progress):
        try:
            images.append(inspect_image(folder / name, name=name))
        except UserError as error:
            lost[name] = str(error)
    return images, lost


def extract(
    weights: Weights, images: Iterable[ImageFile], *, config: Config
) -> dict[str, ImageFeatures]:
    """Dense features of images, by name; all of them in memory (50 MB for 1536 x 1024).

    Raises:
      ImageError: an image cannot be decoded.
    """
    weights = on_device(weights)
    return {image.name: image_features(weights, image, config=config) for image in images}


def on_device(weights: Weights) -> Weights:
    """The same weights with their arrays on the accelerator, copied once instead of per image."""
    return dataclasses.replace(weights, params=jax.device_put(weights.params))


def match(
    features: Mapping[str, ImageFeatures],
    pairs: Iterable[tuple[str, str]],
    *,
    config: Config,
    seed: int = 0,
) -> dict[Pair, PairResult]:
    """Verified matches of pairs of images, by pair (the lesser name first).

    A pair's result depends on the two images, the config and the seed; not on other pairs.
    """
    results = {}
    for a, b in pairs:
        pair = make_pair(a, b)
        results[pair] = match_features(
            features[pair[0]], features[pair[1]], config=config, seed=seed
        )
    return results


def match_features(
    features0: ImageFeatures, features1: ImageFeatures, *, config: Config, seed: int = 0
) -> PairResult:
    """Verified matches of two images, in the order given."""
    sides = (features0.dense, features1.dense)
    room = max(dense.coarse[0].shape[0] for dense in sides)
    widest = max(int(dense.coarse_grid[1]) for dense in sides)
    shape = config.pair
    if shape.consensus and widest > shape.coarse_columns:
        shape = dataclasses.replace(shape, coarse_columns=-(-widest // 64) * 64)
    key = pair_key(jax.random.key(seed), features0.image.identity, features1.image.identity)
    found = match_pair(
        key,
        *(pad_features(dense, room) for dense in sides),
        thresholds(config),
        shape=shape,
    )
    return to_original_pixels(jax.device_get(found), features0, features1)


def thresholds(config: Config) -> Thresholds:
    """The config's traced half."""
    return Thresholds(
        np.float32(config.threshold_px),  # pyright: ignore[reportArgumentType]
        np.int32(config.min_inliers),  # pyright: ignore[reportArgumentType]
        np.float32(config.confidence),  # pyright: ignore[reportArgumentType]
    )


def to_original_pixels(
    found: PairMatches, features0: ImageFeatures, features1: ImageFeatures
) -> PairResult:
    """From the program's padded output to lists in original pixels."""
    keep = np.asarray(found.plane) >= 0
    cells = np.asarray(found.cells)[keep]

    def keypoints(features: ImageFeatures, side: int) -> np.ndarray:
        xy = np.asarray(features.dense.keypoints, np.float64)[cells[:, side]]
        return np.asarray(rescale(xy, np.asarray(features.scale))).astype(np.float32)

    # In float64 on the host: 1600 px coordinates squared leave float32 no digits to invert with.
    present = np.asarray(found.num_inliers) > 0
    to0, to1 = _scale_matrix(features0.scale), _scale_matrix(features1.scale)
    h = to1 @ np.asarray(found.homographies, np.float64)[present] @ np.linalg.inv(to0)
    norms = np.linalg.norm(h, axis=(1, 2), keepdims=True)
    return PairResult(
        pair=(features0.image.name, features1.image.name),
        cells=cells,
        keypoints0=keypoints(features0, 0),
        keypoints1=keypoints(features1, 1),
        plane=np.asarray(found.plane)[keep],
        homographies=h / norms,
        num_tentative=int(found.num_tentative),
        num_dropped=int(found.num_dropped),
        status=Status(int(found.status)),
    )


def _scale_matrix(scale: tuple[float, float]) -> np.ndarray:
    """`rescale` on homogeneous (x, y, 1), float64."""
    sx, sy = scale
    return np.asarray([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1.0]])


def pixel_scale(images: list[ImageFile], *, config: Config) -> float:
    """Median of original pixels per working pixel: localisation errors grow with it."""
    working = [working_size(image.size, config.max_size, config.enlarge) for image in images]
    ratios = [max(i.size) / max(size) for i, size in zip(images, working, strict=True)]
    return float(np.median(ratios))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reconstructed:
    """What became of verified matches."""

    models: "list[pycolmap.Reconstruction]"
    """The one with most images first; empty if none."""
    verdicts: dict[Pair, Verdict]
    """The view graph's, by pair; empty where it is switched off."""
    verified: dict[Pair, int]
    """COLMAP's two-view inliers, by pair that has any."""
    attempts: "list[Attempt]"
    """Runs of the mapper."""
    refinement: "list[RefinementFigures | None]"
    """Per model; None where it was not refined."""


def reconstruct(
    images: list[ImageFile],
    matches: Mapping[Pair, PairResult],
    database: Path,
    *,
    config: Config,
    intrinsics: "Intrinsics | None" = None,
    options: "MapOptions | None" = None,
    on_image: Callable[[], None] = lambda: None,
    on_pass: Callable[[], None] = lambda: None,
    on_mapped: Callable[[], None] = lambda: None,
) -> Reconstructed:
    """COLMAP models from verified matches: view graph, mapping, refinement.

    Pixel thresholds are multiplied by `pixel_scale`; points get the photos' colours.

    Args:
      matches: as from `match`.
      database: where to write the COLMAP database; replaced.
      config: the one the matches were made with; its `view_graph` and `refinement` switch those
        stages on.
      intrinsics: one known camera for all images; None takes one camera per photo.
      options: default: incremental, refining the intrinsics unless they are given.
      on_image, on_mapped, on_pass: told of every registered image, of the end of mapping, of every
        pass of the refinement.
    """
    from jaxsfm.host import colmap, mapping
    from jaxsfm.host.intrinsics import check_fits

    if options is None:
        options = mapping.MapOptions(refine_intrinsics=intrinsics is None)
    options = dataclasses.replace(options, scale=pixel_scale(images, config=config))
    if intrinsics is not None:
        check_fits(intrinsics, {image.name: image.size for image in images})
    colmap.write_database(database, images, matches, intrinsics)
    colmap.verify(
        database,
        seed=options.seed,
        threads=options.threads,
        scale=options.scale,
        relative_poses=config.view_graph,
    )
    two_views = colmap.read_two_views(database)
    verified = {pair: view.geometry.num_inliers for pair, view in two_views.items()}
    verdicts: dict[Pair, Verdict] = {}
    if config.view_graph:
        verdicts = trusted_pairs({pair: view.geometry for pair, view in two_views.items()})
        dropped = [pair for pair, verdict in verdicts.items() if not verdict.trusted]
        colmap.drop_pairs(database, dropped)
        for pair in dropped:
            del two_views[pair]
    models, attempts = mapping.build_models(database, two_views, options, on_image=on_image)
    on_mapped()
    by_name = {image.name: image for image in images}

    def read(name: str) -> tuple[np.ndarray, tuple[float, float]]:
        working = read_image(by_name[name], max_size=config.max_size, enlarge=config.enlarge)
        return working.rgb, working.scale

    figures: list[RefinementFigures | None] = [None] * len(models)
    if config.refinement is not None:
        cameras = colmap.read_images(database)
        models, figures = _refine(
            models, read, config.refinement, options, matches, cameras, on_pass
        )
    for model in models:
        colmap.colour_points(model, read)
    return Reconstructed(
        models=models,
        verdicts=verdicts,
        verified=verified,
        attempts=attempts,
        refinement=figures,
    )


def _refine(
    models: "list[pycolmap.Reconstruction]",
    read: Callable[[str], tuple[np.ndarray, tuple[float, float]]],
    config: Refinement,
    options: "MapOptions",
    matches: Mapping[Pair, PairResult],
    cameras: "Mapping[str, tuple[int, pycolmap.Camera]]",
    on_pass: Callable[[], None],
) -> "tuple[list[pycolmap.Reconstruction], list[RefinementFigures | None]]":
    from jaxsfm.host.mapping import registered
    from jaxsfm.refine import refine_model
    from jaxsfm.weak_views import Evidence, LeftOut

    @functools.lru_cache(maxsize=GRAYS)
    def read_gray(name: str) -> tuple[np.ndarray, tuple[float, float]]:
        rgb, scale = read(name)
        return gray(rgb), scale

    refined, figures = [], []
    mapped = {name for model in models for name in registered(model)}
    left_out = [LeftOut(name, *cameras[name]) for name in sorted(cameras.keys() - mapped)]
    for model in models:
        try:
            new, done = refine_model(
                model,
                read_gray,
                config=config,
                refine_intrinsics=options.refine_intrinsics,
                evidence=Evidence(matches, left_out, options.seed),
                threads=options.threads,
                on_pass=on_pass,
            )
        except ImageError as error:  # a photo went away since; the mapper's model is there
            logger.warning("no refinement: %s", error)
            new, done = model, None
        left_out = [image for image in left_out if image.name not in registered(new)]
        refined.append(new)
        figures.append(done)
    return refined, figures
