"""Ground control points, triangulated in a finished model from where photos show them."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from jaxsfm.colmap.view import View
from jaxsfm.io.pixels import Pixels

if TYPE_CHECKING:
    import pycolmap

CLICK_PX = 2.0
"""Errors of measurements well beyond this many pixels lose their weight (soft L1)."""
PARALLEL = 1e-6
"""Rays with a smaller squared sine between them leave the depth of a point unknown."""
BEHIND_PX = 1e6
"""Stands for the error of a point that lies behind a camera, which has no image of it."""


class TriangulatedPoint(NamedTuple):
    """A control point in the frame of a model."""

    xyz: np.ndarray
    """float64 (3,)."""
    errors_px: dict[str, float]
    """By the name of the photo: from the measurement to where the model projects the point,
    original pixels."""


def views_by_name(model: "pycolmap.Reconstruction") -> dict[str, View]:
    """The views of a model's registered images, in original pixels."""
    views = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        camera = model.camera(image.camera_id)
        views[image.name] = View(
            image_id=image_id,
            name=image.name,
            rotation=image.cam_from_world().rotation.matrix(),
            centre=np.asarray(image.projection_center()),
            camera=camera,
            pixels=Pixels((1.0, 1.0)),
            size=(camera.width, camera.height),
        )
    return views


def triangulated(
    views: Mapping[str, View], seen: Mapping[str, tuple[float, float]]
) -> TriangulatedPoint | None:
    """The point that photos show at the given pixels.

    The sum of squared reprojection errors is minimised, from the point that is nearest to all rays.
    A measurement that is far off counts less.

    Args:
      views: of the model, by name.
      seen: (x, y) in original pixels, by the name of the photo; photos without a view are ignored.

    Returns:
      None if fewer than two views show the point, or their rays are parallel.
    """
    shown = [(views[name], np.asarray([xy])) for name, xy in sorted(seen.items()) if name in views]
    if len(shown) < 2:
        return None
    rays = np.concatenate([view.rays(xy) for view, xy in shown])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    centres = np.asarray([view.centre for view, _ in shown])
    normal = across.sum(0)
    if not np.linalg.eigvalsh(normal)[0] > PARALLEL:
        return None
    start = np.linalg.solve(normal, np.einsum("nij,nj->i", across, centres))
    depth = np.median(np.linalg.norm(centres - start, axis=1))

    def errors(moved: np.ndarray) -> np.ndarray:
        point = start + depth * moved  # scaled, so that the units of the model do not matter
        found = [view.project(point[None])[0] - xy for view, xy in shown]
        return np.nan_to_num(np.concatenate(found), nan=BEHIND_PX).ravel()

    solved = least_squares(errors, np.zeros(3), loss="soft_l1", f_scale=CLICK_PX, xtol=1e-12)
    lengths = np.linalg.norm(errors(solved.x).reshape(-1, 2), axis=1)
    by_name = {view.name: float(px) for (view, _), px in zip(shown, lengths, strict=True)}
    return TriangulatedPoint(start + depth * solved.x, by_name)
