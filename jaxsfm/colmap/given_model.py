"""A COLMAP model that another tool has made: whether it can be refined, and its figures."""

import dataclasses
from pathlib import Path

import pycolmap

from jaxsfm.colmap.poses import find_model, read_model
from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name

SPHERICAL = "EQUIRECTANGULAR"
"""COLMAP's camera model of 360-degree photos. It has no image plane."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelFigures:
    """What a model holds."""

    images: int
    """Those with a pose."""
    points: int
    observations: int
    track_length: float
    """The mean over the points."""
    reprojection_error_px: float
    """The mean over the points, original pixels."""


def figures_of(model: pycolmap.Reconstruction) -> ModelFigures:
    """The figures of a model whose errors are up to date (`update_point_3d_errors`)."""
    return ModelFigures(
        images=model.num_reg_images(),
        points=model.num_points3D(),
        observations=model.compute_num_observations(),
        track_length=model.compute_mean_track_length(),
        reprojection_error_px=model.compute_mean_reprojection_error(),
    )


def read_given_model(path: Path) -> pycolmap.Reconstruction:
    """Read a model that can be refined. The errors of its points are computed anew.

    Args:
      path: the folder of a model, or one that holds a model (`find_model`).

    Raises:
      UserError: there is no model, it is damaged, or it cannot be refined: it has fewer than two
        images with a pose, no points that two images observe, or cameras without an image plane.
    """
    if not path.is_dir():
        raise UserError(f"{path}: no such folder")
    folder = find_model(path)
    model = read_model(folder)
    if model.num_reg_images() < 2:
        raise UserError(
            f"{folder}: {model.num_reg_images()} images with a pose; a refinement needs two"
        )
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        camera = model.camera(image.camera_id)
        if camera.model_name == SPHERICAL:
            raise UserError(
                f"{folder}: {shown_name(image.name)} has a camera of the model {SPHERICAL}; "
                "360-degree photos cannot be refined"
            )
    if not any(point.track.length() > 1 for point in model.points3D.values()):
        raise UserError(
            f"{folder}: no points that two images observe, so there is nothing to refine; "
            "triangulate points first (colmap point_triangulator)"
        )
    model.update_point_3d_errors()
    return model


def looks_calibrated(model: pycolmap.Reconstruction) -> bool:
    """Whether the cameras of all images with a pose seem to have been known beforehand.

    COLMAP puts the principal point of a camera that it guesses into the image's centre, and its
    mapper leaves it there. So a principal point beside the centre comes from a calibration, or from
    our refinement.
    """
    return not any(
        camera.principal_point_x == camera.width / 2
        and camera.principal_point_y == camera.height / 2
        for camera in _used_cameras(model)
    )


def shares_cameras(model: pycolmap.Reconstruction) -> bool:
    """Whether a camera has two images or more in the mean, of the images with a pose."""
    return model.num_reg_images() >= 2 * len(_used_cameras(model))


def _used_cameras(model: pycolmap.Reconstruction) -> list[pycolmap.Camera]:
    used = {model.image(image_id).camera_id for image_id in model.reg_image_ids()}
    return [model.camera(camera_id) for camera_id in sorted(used)]
