"""The stages composed: extract -> match -> reconstruct.

Every stage is a function of its inputs and a config. `jaxsfm.run_folder` strings them together in a
work folder.
"""

import dataclasses
import functools
import logging
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from jaxsfm.config import Config, Refinement
from jaxsfm.errors import UserError
from jaxsfm.execution import Execution
from jaxsfm.extraction import extracted
from jaxsfm.host.features import ImageFeatures
from jaxsfm.host.images import (
    ImageError,
    ImageFile,
    find_images,
    inspect_image,
    read_image,
    working_size,
)
from jaxsfm.host.pairs import Pair, PairResult
from jaxsfm.host.viewgraph import Verdict, trusted_pairs
from jaxsfm.host.weights import Weights
from jaxsfm.matching import matched
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
    weights: Weights,
    images: Iterable[ImageFile],
    *,
    config: Config,
    execution: Execution | None = None,
) -> dict[str, ImageFeatures]:
    """Dense features of images, by name; all of them in memory (25 MB for 1536 x 1024).

    Raises:
      ImageError: an image cannot be decoded.
    """
    features = {}
    for image, found in extracted(weights, images, config=config, execution=execution):
        if isinstance(found, ImageError):
            raise found
        features[image.name] = found
    return features


def match(
    features: Mapping[str, ImageFeatures],
    pairs: Iterable[tuple[str, str]],
    *,
    config: Config,
    seed: int = 0,
    execution: Execution | None = None,
) -> dict[Pair, PairResult]:
    """Verified matches of pairs of images, by pair (the lesser name first).

    A pair's result depends on the two images, the config and the seed; not on other pairs.
    """
    rooms = {name: each.room for name, each in features.items()}
    results = matched(
        features.__getitem__, rooms, pairs, config=config, seed=seed, execution=execution
    )
    return {result.pair: result for result in results}


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
    angles: dict[Pair, float]
    """Degrees at which the rays of a verified pair's points meet (median); 0: unknown."""
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
    angles = {pair: view.tri_angle_deg for pair, view in two_views.items()}
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
        angles=angles,
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
