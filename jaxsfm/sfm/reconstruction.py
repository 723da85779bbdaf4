"""From verified matches to models: verification and view graph, mapping, refinement.

Each stage reads the files of the one before, so that one that is kept (`jaxsfm.run_folder`) gives
what it would give if it were made again.
"""

import dataclasses
import json
import logging
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsfm.config import Config, Refinement
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Photos, Reader
from jaxsfm.io.store import digest
from jaxsfm.io.versions import package_versions
from jaxsfm.sfm.stages import StageCache, TemporaryStages, run_stage
from jaxsfm.sfm.view_graph import Verdict, trusted_pairs

if TYPE_CHECKING:
    import pycolmap

    from jaxsfm.colmap.intrinsics import Intrinsics
    from jaxsfm.colmap.mapper import Attempt, MapOptions
    from jaxsfm.sfm.refine.passes import RefinementFigures

DATABASE, SPARSE = "database.db", "sparse"
_FIGURES = "figures.json"
logger = logging.getLogger("jaxsfm")


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
    kept: StageCache | None = None,
    on_image: Callable[[], None] = lambda: None,
    on_pass: Callable[[], None] = lambda: None,
    on_mapped: Callable[[], None] = lambda: None,
) -> Reconstructed:
    """COLMAP models from verified matches: view graph, mapping, refinement.

    Pixel thresholds are multiplied by `Photos.median_scale`; points get the photos' colours.

    Args:
      matches: as from `match`.
      database: where to write the COLMAP database; replaced.
      config: the one the matches were made with; its `view_graph` and `refinement` switch those
        stages on.
      intrinsics: one known camera for all images; None takes one camera per photo.
      options: default: incremental, refining the intrinsics unless they are given.
      kept: stages that were finished before are taken from there, new ones are kept there.
      on_image, on_mapped, on_pass: told of every registered image, of the end of mapping, of every
        pass of the refinement.
    """
    from jaxsfm.colmap import mapper as mapping
    from jaxsfm.colmap import models as colmap_models
    from jaxsfm.colmap.intrinsics import check_fits
    from jaxsfm.colmap.two_views import read_two_views

    if options is None:
        options = mapping.MapOptions(refine_intrinsics=intrinsics is None)
    photos = Photos(images, config)
    options = dataclasses.replace(options, scale=photos.median_scale())
    if intrinsics is not None:
        check_fits(intrinsics, {image.name: image.size for image in images})

    def verify(folder: Path) -> None:
        _verify(folder, images, matches, intrinsics, options, config.view_graph)

    def build(folder: Path) -> None:
        two_views = read_two_views(checked / DATABASE)
        models, attempts = mapping.build_models(
            checked / DATABASE, two_views, options, on_image=on_image
        )
        colmap_models.write_models(models, folder / SPARSE)
        _write_json(folder, [dataclasses.asdict(attempt) for attempt in attempts])

    def refine(folder: Path) -> None:
        models = colmap_models.read_models(mapped / SPARSE, checked / DATABASE)
        models, figures = _refined(models, photos, checked, config, options, matches, on_pass)
        colmap_models.write_models(models, folder / SPARSE)
        _write_json(folder, [each and dataclasses.asdict(each) for each in figures])

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        stages, key = kept or (TemporaryStages(scratch), "")
        by_image = [[image.name, image.sha256, image.size] for image in images]
        camera = intrinsics and dataclasses.asdict(intrinsics)
        verifying = [options.seed, options.threads, options.scale, config.view_graph]
        key = digest(key, by_image, camera, verifying, package_versions())
        checked = run_stage(stages, "verified", key, verify)
        key = digest(key, dataclasses.asdict(options))
        mapped = run_stage(stages, "mapped", key, build)
        on_mapped()
        key = digest(key, config.refinement and dataclasses.asdict(config.refinement))
        refined = run_stage(stages, "refined", key, refine)
        shutil.copyfile(checked / DATABASE, database)
        verification, refinement = _read_json(checked), _read_json(refined)
        models = colmap_models.read_models(refined / SPARSE, database)
        if config.refinement is not None and None in refinement:
            stages.forget_stage("refined")  # a photo could not be read; perhaps the next time
        return Reconstructed(
            models=models,
            verdicts={(a, b): Verdict(**row) for (a, b), row in verification["verdicts"]},
            verified={(a, b): count for (a, b), count, _ in verification["verified"]},
            angles={(a, b): angle for (a, b), _, angle in verification["verified"]},
            attempts=[mapping.Attempt(**_paired(row)) for row in _read_json(mapped)],
            refinement=[_figures(row) for row in refinement],
        )


def _write_json(folder: Path, value: Any) -> None:
    (folder / _FIGURES).write_text(json.dumps(value), encoding="utf-8")


def _read_json(folder: Path) -> Any:
    return json.loads((folder / _FIGURES).read_text(encoding="utf-8"))


def _paired(row: dict[str, Any]) -> dict[str, Any]:
    initial = row["initial_pair"]
    return row | {"initial_pair": initial and tuple(initial)}


def _figures(row: dict[str, Any] | None) -> "RefinementFigures | None":
    from jaxsfm.sfm.refine.passes import PassFigures, RefinementFigures
    from jaxsfm.sfm.refine.weak_views import Placement

    if row is None:
        return None
    return RefinementFigures(
        passes=[PassFigures(**each) for each in row["passes"]],
        placed=[Placement(**each) for each in row["placed"]],
    )


def _verify(
    folder: Path,
    images: list[ImageFile],
    matches: Mapping[Pair, PairResult],
    intrinsics: "Intrinsics | None",
    options: "MapOptions",
    view_graph: bool,
) -> None:
    """The database, of which pairs that the view graph does not trust have lost their geometry."""
    from jaxsfm.colmap import database as colmap
    from jaxsfm.colmap.two_views import read_two_views

    database = folder / DATABASE
    colmap.write_database(database, images, matches, intrinsics)
    colmap.verify(
        database,
        seed=options.seed,
        threads=options.threads,
        scale=options.scale,
        relative_poses=view_graph,
    )
    two_views = read_two_views(database)
    geometries = {pair: view.geometry for pair, view in two_views.items()}
    verdicts = trusted_pairs(geometries) if view_graph else {}
    colmap.drop_pairs(database, [pair for pair, v in verdicts.items() if not v.trusted])
    _write_json(
        folder,
        {
            "verdicts": [[pair, dataclasses.asdict(v)] for pair, v in verdicts.items()],
            "verified": [
                [pair, view.geometry.num_inliers, view.tri_angle_deg]
                for pair, view in two_views.items()
            ],
        },
    )


def _refined(
    models: "list[pycolmap.Reconstruction]",
    photos: Photos,
    checked: Path,
    config: Config,
    options: "MapOptions",
    matches: Mapping[Pair, PairResult],
    on_pass: Callable[[], None],
) -> "tuple[list[pycolmap.Reconstruction], list[RefinementFigures | None]]":
    """Refined where the config says so, and coloured."""
    from jaxsfm.colmap import database as colmap
    from jaxsfm.colmap.models import colour_points

    figures: list[RefinementFigures | None] = [None] * len(models)
    if config.refinement is not None:
        cameras = colmap.read_images(checked / DATABASE)
        models, figures = _refine(
            models, photos.gray, config.refinement, options, matches, cameras, on_pass
        )
    for model in models:
        colour_points(model, photos.rgb)
    return models, figures


def _refine(
    models: "list[pycolmap.Reconstruction]",
    read_gray: Reader,
    config: Refinement,
    options: "MapOptions",
    matches: Mapping[Pair, PairResult],
    cameras: "Mapping[str, tuple[int, pycolmap.Camera]]",
    on_pass: Callable[[], None],
) -> "tuple[list[pycolmap.Reconstruction], list[RefinementFigures | None]]":
    from jaxsfm.colmap.mapper import registered
    from jaxsfm.sfm.refine.passes import refine_model
    from jaxsfm.sfm.refine.weak_views import Evidence, UnmappedImage

    refined, figures = [], []
    mapped = {name for model in models for name in registered(model)}
    left_out = [UnmappedImage(name, *cameras[name]) for name in sorted(cameras.keys() - mapped)]
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
    # Images came and went: the first is the one with most.
    order = sorted(range(len(refined)), key=lambda k: -refined[k].num_reg_images())
    return [refined[k] for k in order], [figures[k] for k in order]
