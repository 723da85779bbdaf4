"""The refinement of a model that another tool has made."""

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.model_folders import colour_points
from jaxsfm.colmap.other_camera import other_camera
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.updated_model import has_rigs, updated
from jaxsfm.config import Refinement
from jaxsfm.sfm.model_photos import ModelPhotos
from jaxsfm.sfm.old_frame import move_back
from jaxsfm.sfm.refine.one_pass import PassSettings
from jaxsfm.sfm.refine.passes import RefinementFigures, refine_model

if TYPE_CHECKING:
    import pycolmap

GOOD_ERROR_PX = 1.0
"""The alignment starts at working size if the median reprojection error is smaller than about 1.4
times this, working pixels."""
MAX_OCTAVE = 3
"""It starts at an eighth of the working size at most."""


class GivenRefinement(NamedTuple):
    """The outcome of the refinement of a given model."""

    model: "pycolmap.Reconstruction"
    """It lies where the given model did."""
    figures: RefinementFigures


def refine_given(
    given: "pycolmap.Reconstruction",
    photos: ModelPhotos,
    *,
    refinement: Refinement,
    refine_intrinsics: bool,
    threads: int,
    on_pass: Callable[[], None] = lambda: None,
) -> GivenRefinement | None:
    """Refine a model that another tool has made; None if too little agrees with the photos.

    Args:
      given: `jaxsfm.colmap.given_model.read_given_model` has read it. It is not changed.
      refine_intrinsics: whether bundle adjustment moves focal lengths and distortion.
      threads: of bundle adjustment. With one thread the model is repeatable to the last byte.
    """
    refined, figures = refine_model(
        given,
        photos.gray,
        PassSettings(refinement, refine_intrinsics, threads),
        described_px=_described_px(given, photos),
        on_pass=on_pass,
    )
    if not figures.confirmed:
        return None
    colour_points(refined, photos.rgb)
    model = updated(given, refined)
    if has_rigs(model):
        bundle_adjust(model, loss_px=1.0, refine_intrinsics=refine_intrinsics, threads=threads)
    move_back(model, model_poses(given))
    if not refine_intrinsics:
        figures = dataclasses.replace(figures, camera=other_camera(model, threads=threads))
    return GivenRefinement(model, figures)


def _described_px(given: "pycolmap.Reconstruction", photos: ModelPhotos) -> int:
    """The size of a pixel at which the alignment starts, a power of two of working pixels.

    It is about the median error of the observations, so that the model puts points within the
    reach of the alignment.
    """
    sizes = {}
    for image_id in given.reg_image_ids():
        name = given.image(image_id).name
        gray, scale = photos.gray(name)
        sizes[name] = (gray.shape[1], gray.shape[0]), scale
    errors = Model.from_colmap(given, sizes).errors_px()
    octave = round(math.log2(max(1.0, float(np.median(errors)) / GOOD_ERROR_PX)))
    return 2 ** min(octave, MAX_OCTAVE)
