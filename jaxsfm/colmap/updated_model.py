"""A model with the poses, cameras and points that a refinement found, and all else as it was."""

import pycolmap


def updated(
    original: pycolmap.Reconstruction, refined: pycolmap.Reconstruction
) -> pycolmap.Reconstruction:
    """A copy of a model, with the poses, cameras, points and observations of a refined one.

    Ids and names of images and cameras, rigs and frames are those of the original. An image that
    the refinement took out keeps no pose. The images of a frame of a rig with several cameras move
    together: the frame gets the pose that the refinement gave to one of them, the reference camera
    if it can. The caller adjusts such a model (`has_rigs`).

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
