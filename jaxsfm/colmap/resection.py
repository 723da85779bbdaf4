"""Resection: the pose of a camera from points whose places are known, by COLMAP."""

import dataclasses

import numpy as np
import pycolmap

from jaxsfm.colmap.view import View

MIN_RESECTION_POINTS = 6
"""Fewer matches give no pose."""
MIN_INLIER_SHARE = 0.05
"""RANSAC expects at least this share of the matches to be right. COLMAP's own value is a quarter,
but most matches of a dark image are wrong."""


def _moved(view: View, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> View:
    rotation = cam_from_world.rotation.matrix()
    centre = -rotation.T @ cam_from_world.translation
    return dataclasses.replace(view, rotation=rotation, centre=centre, camera=camera)


def adjust_view(
    view: View, xy: np.ndarray, points: np.ndarray, *, refine_focal_length: bool
) -> View | None:
    """Adjust the pose of a view to observations, starting from the pose that it has.

    Least squares with a Cauchy loss of one working pixel.

    Args:
      xy: float64 (n, 2), where the view shows the points, working pixels.
      points: float64 (n, 3), world units.

    Returns:
      None if the solver fails.
    """
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.loss_function_scale = view.mean_scale
    options.refine_focal_length = refine_focal_length
    camera = pycolmap.Camera(view.camera.todict())  # the solver writes into it
    found = pycolmap.refine_absolute_pose(
        view.cam_from_world(),
        view.pixels.to_colmap(xy),
        points,
        np.ones(len(points), bool),
        camera,
        options,
    )
    return None if found is None else _moved(view, found["cam_from_world"], camera)


def find_view(
    view: View,
    xy: np.ndarray,
    points: np.ndarray,
    *,
    max_error_px: float,
    estimate_focal_length: bool,
    seed: int,
    min_inlier_share: float = MIN_INLIER_SHARE,
) -> View | None:
    """Find the pose of a view by RANSAC. The pose that `view` has plays no part.

    Args:
      xy, points: as in `adjust_view`; some of them may be wrong.
      max_error_px: the largest reprojection error of an inlier, working pixels.
      min_inlier_share: RANSAC ends when it has surely found a pose with this share of inliers.

    Returns:
      None if no pose is found.
    """
    if len(points) < MIN_RESECTION_POINTS:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.estimate_focal_length = estimate_focal_length
    options.ransac.max_error = max_error_px * view.mean_scale
    options.ransac.min_inlier_ratio = min_inlier_share
    options.ransac.random_seed = seed
    camera = pycolmap.Camera(view.camera.todict())
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = estimate_focal_length
    refinement.loss_function_scale = options.ransac.max_error / 4
    found = pycolmap.estimate_and_refine_absolute_pose(
        view.pixels.to_colmap(xy), points, camera, options, refinement
    )
    return None if found is None else _moved(view, found["cam_from_world"], camera)
