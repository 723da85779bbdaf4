"""A COLMAP model that another tool has made: whether it can be refined, its figures, a copy with
what a refinement found, and the cameras of its photos when it is joined to another model."""

import dataclasses
from collections.abc import Collection
from pathlib import Path

import pycolmap

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.model_files import find_model, read_model
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


def updated(
    original: pycolmap.Reconstruction, refined: pycolmap.Reconstruction
) -> pycolmap.Reconstruction:
    """A copy of a model, with the poses, cameras, points and observations of a refined one.

    Ids and names of images and cameras, rigs and frames are those of the original. An image that
    the refinement took out keeps no pose. The images of a frame of a rig with several cameras move
    together: the frame gets the pose that the refinement gave to one of them, the reference camera
    if it can. The caller adjusts such a model once more (`has_rigs`).

    Args:
      original: not changed.
      refined: its images are among the original's.
    """
    model = pycolmap.Reconstruction(original)
    model.delete_all_points2D_and_points3D()
    for image_id, image in model.images.items():
        # An image that was taken out is emptied too, so that COLMAP counts its points anew.
        there = refined.exists_image(image_id)
        pixels = [point.xy for point in refined.image(image_id).points2D] if there else []
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels])
    for camera_id in model.cameras:
        if refined.exists_camera(camera_id):
            model.camera(camera_id).params = refined.camera(camera_id).params.tolist()
    for rig in model.rigs.values():
        number = rig.ref_sensor_id.id  # that of the rig in the refined model
        for sensor in rig.non_ref_sensors if refined.exists_rig(number) else ():
            if refined.rig(number).has_sensor(sensor):
                rig.set_sensor_from_rig(sensor, refined.rig(number).sensor_from_rig(sensor))
    left = set(refined.reg_image_ids())
    for frame_id in sorted(model.reg_frame_ids()):
        frame = model.frame(frame_id)
        there = [model.image(i.id) for i in frame.image_ids if i.id in left]
        if not there:
            model.deregister_frame(frame_id)
            continue
        chosen = min(there, key=lambda image: (not image.is_ref_in_frame(), image.image_id))
        pose = refined.image(chosen.image_id).cam_from_world()
        frame.set_cam_from_world(chosen.camera_id, pose)
    for point_id in sorted(refined.point3D_ids()):
        point = refined.point3D(point_id)
        model.add_point3D(point.xyz, point.track, point.color)
    model.update_point_3d_errors()
    return model


def has_rigs(model: pycolmap.Reconstruction) -> bool:
    """Whether the model has a rig of more than one camera."""
    return any(rig.num_sensors() > 1 for rig in model.rigs.values())


def joined_cameras(
    first: Model, second: Model, shared: Collection[str]
) -> dict[int, pycolmap.Camera]:
    """The camera that stands for each camera of the second model's views, by its id.

    If shared photos were taken with it, and all of these have one and the same camera in the first
    model, of the same kind and size, it is that camera. Otherwise it gets a new id.
    """
    own = {view.name: view.camera for view in first.views}
    used: dict[int, set[int]] = {}
    for view in second.views:
        partners = used.setdefault(view.camera.camera_id, set())
        if view.name in shared:
            partners.add(own[view.name].camera_id)
    cameras = {camera.camera_id: camera for camera in own.values()}
    theirs = {view.camera.camera_id: view.camera for view in second.views}
    fresh = max([*cameras, *first.cameras]) + 1
    joined = {}
    for camera_id in sorted(used):
        camera, partners = theirs[camera_id], used[camera_id]
        partner = cameras[min(partners)] if len(partners) == 1 else None
        if partner is not None and _alike(camera, partner):
            joined[camera_id] = partner
        else:
            joined[camera_id] = pycolmap.Camera({**camera.todict(), "camera_id": fresh})
            fresh += 1
    return joined


def _alike(a: pycolmap.Camera, b: pycolmap.Camera) -> bool:
    return (a.model, a.width, a.height) == (b.model, b.width, b.height)
