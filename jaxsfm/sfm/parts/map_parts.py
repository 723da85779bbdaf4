"""Mapping of many photos in parts.

COLMAP's incremental mapper adjusts its whole model again and again, so its time grows faster than
the number of photos. Parts of a fixed size take time in proportion to the number of photos. Their
models share photos, by which they are joined, and the whole is adjusted once.
"""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import Attempt, Mapped, MapperRun, first_models
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.colmap.model_images import ordered, registered, registered_in_any
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.model_join import ERROR_PX, JOIN_ERROR_PX, MIN_SHARED, adjusted
from jaxsfm.sfm.parts.frames import common_frames, shared_points
from jaxsfm.sfm.parts.merge import merged
from jaxsfm.sfm.parts.partition import graph_of, overlapping_parts

if TYPE_CHECKING:
    import pycolmap

MANY = 200
"""More photos than these are mapped in parts."""
PART, OVERLAP = 80, 20
"""Photos of a part, and photos that two parts share."""
COARSE = 16.0
"""The first adjustment of the whole allows so many times the error of a right observation: where
models lie in a ring, its ends may not meet."""
WHOLE = 0.9
"""The largest model must have this share of the photos that the parts have, or the parts do not
count."""

logger = logging.getLogger("jaxsfm")


def map_in_parts(
    database: Path,
    matches: Mapping[Pair, int],
    options: MapOptions,
    *,
    on_image: Callable[[], None] = lambda: None,
    run: MapperRun | None = None,
) -> Mapped | None:
    """Map the photos of a verified database in parts, and join the models of the parts.

    Args:
      database: with the verified pairs.
      matches: the number of verified matches of each pair in it.
      on_image: called for every image that the mapper registers.
      run: runs the mapper, or gives what an earlier run gave; None: `run_mapper`.

    Returns:
      the models; None if the parts do not give one model of nearly all their photos.

    Raises:
      UserError: COLMAP failed.
    """
    parts = overlapping_parts(graph_of(matches), size=PART, overlap=OVERLAP)
    logger.info("mapping in %d parts", len(parts))
    found: list[pycolmap.Reconstruction] = []
    attempts: list[Attempt] = []
    for names in parts:
        made = first_models(database, options, names=names, on_image=on_image, run=run)
        found += [model for model in made.models if model.num_reg_images() >= MIN_SHARED]
        attempts += made.attempts
    found.sort(
        key=lambda each: (-each.num_reg_images(), -each.num_points3D(), min(each.reg_image_ids()))
    )
    models = [Model.from_colmap(each, stored_sizes(each)) for each in found]
    shared = shared_points(models, error_px=JOIN_ERROR_PX * options.scale)
    whole = []
    for frames in common_frames(len(models), shared):
        if len(frames) == 1:
            whole.append(found[next(iter(frames))])
            continue
        joined = adjusted(
            merged(models, frames),
            error_px=ERROR_PX * options.scale,
            refine_intrinsics=options.refine_intrinsics,
            threads=options.threads,
            slacks=(COARSE, 4.0, 1.0),
        )
        whole.append(joined)
    whole = ordered(whole)
    photos = registered_in_any(found)
    if not whole or len(registered(whole[0])) < WHOLE * len(photos):
        logger.info("the models of the parts do not make one model")
        return None
    return Mapped(whole, attempts)
