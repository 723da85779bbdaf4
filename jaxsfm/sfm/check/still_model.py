"""Whether a model is one of what stays at the same pixels in all photos, not of the scene."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from jaxsfm.sfm.refined_stage import Reconstructed

if TYPE_CHECKING:
    import pycolmap

SHARE = 0.5
"""A model is of still pixels if more of its observations lie on them: what most of it rests on
decides how it is adjusted. In a right model few do, because points move across the photos."""


def with_still_models(made: Reconstructed, still: np.ndarray) -> Reconstructed:
    """The models with checks that say which of them rest on still pixels.

    Args:
      still: bool (h, w), pixels at which all photos of this size show the same.
    """
    checks = [
        check and dataclasses.replace(check, same_pixels=of_still_pixels(model, still))
        for check, model in zip(made.mapping.checks, made.models, strict=True)
    ]
    return dataclasses.replace(made, mapping=dataclasses.replace(made.mapping, checks=checks))


def of_still_pixels(model: "pycolmap.Reconstruction", still: np.ndarray) -> bool:
    """Whether more than `SHARE` of the observations of a model lie on still pixels (h, w)."""
    on = found = 0
    for k in model.reg_image_ids():
        image = model.image(k)
        camera = model.camera(image.camera_id)
        if (camera.height, camera.width) == still.shape:
            xy = [point.xy for point in image.points2D if point.has_point3D()]
            column, row = np.floor(np.reshape(xy, (-1, 2))).astype(int).T
            here = still[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)]
            on, found = on + int(here.sum()), found + len(here)
    return on > SHARE * found
