"""A camera's pose from points of known place (COLMAP's resection), in working pixels."""

import dataclasses

import cv2  # noqa: F401  before pycolmap: see jaxsfm.colmap.database
import numpy as np
import pycolmap

from jaxsfm.colmap.model import View

MIN_POINTS = 6
MIN_INLIER_SHARE = 0.05
"""Matches of a dark image are mostly wrong; COLMAP expects a quarter of them to be right."""


def _moved(view: View, cam_from_world: pycolmap.Rigid3d, camera: pycolmap.Camera) -> View:
    rotation = cam_from_world.rotation.matrix()
    centre = -rotation.T @ cam_from_world.translation
    return dataclasses.replace(view, rotation=rotation, centre=centre, camera=camera)


def adjust_view(
    view: View, xy: np.ndarray, points: np.ndarray, *, refine_focal_length: bool
) -> View | None:
    """The view where points (n, 3) seen at pixels (n, 2) want it: least squares from where it is,
    with a Cauchy loss of one working pixel. None if the solver fails."""
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.loss_function_scale = float(view.scale.mean())
    options.refine_focal_length = refine_focal_length
    camera = pycolmap.Camera(view.camera.todict())  # the solver writes into it
    found = pycolmap.refine_absolute_pose(
        view.cam_from_world(),
        (xy + 0.5) * view.scale,
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
) -> View | None:
    """The same by RANSAC, from nothing; None if nothing is found.

    Args:
      max_error_px: of an inlier, working pixels.
    """
    if len(points) < MIN_POINTS:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.estimate_focal_length = estimate_focal_length
    options.ransac.max_error = max_error_px * float(view.scale.mean())
    options.ransac.min_inlier_ratio = MIN_INLIER_SHARE
    options.ransac.random_seed = seed
    camera = pycolmap.Camera(view.camera.todict())
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = estimate_focal_length
    refinement.loss_function_scale = options.ransac.max_error / 4
    found = pycolmap.estimate_and_refine_absolute_pose(
        (xy + 0.5) * view.scale, points, camera, options, refinement
    )
    return None if found is None else _moved(view, found["cam_from_world"], camera)
