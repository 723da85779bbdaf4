"""The bundle adjustment of a whole model: what moves, and what no camera may become."""

import copy
from collections import Counter
from collections.abc import Collection

import numpy as np
import pycolmap

from jaxsfm.colmap.adjustment import TOLERANCE, adjustable, cameras_of, minimum, with_cameras
from jaxsfm.colmap.database import camera_sensor
from jaxsfm.colmap.given_model import has_rigs
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.colmap.native import native
from jaxsfm.colmap.poses import CameraPose, nearest_rotation
from jaxsfm.colmap.reconstruction import forget_behind, move_model
from jaxsfm.colmap.rigs import gives_scale
from jaxsfm.colmap.view import View
from jaxsfm.core.bundle_problem import Positions
from jaxsfm.core.cameras import MODELS

VIEWS_FOR_CENTRE = 3
"""The principal point of a camera is adjusted if so many views of the model share it. In a single
view it cannot be told from a small rotation. Of all three neighbours of Herz-Jesus-P8 and of
fountain-P11, the median rotation is off by 0.16 and 0.27 deg instead of 0.47 and 0.60, and the
worst by 0.33 and 0.89 deg instead of 1.14 and 1.29. All eight views of Herz-Jesus-P8 find the point
to 0.4 px, which was 8 px from the centre of the photos."""
FARTHEST_CENTRE = 0.1
"""A principal point that moves farther than this from the centre of the photo, in units of the
longer side, is not believed."""
CENTRE = frozenset({"cx", "cy"})
UNREFINED_LOSS_PX = 2.0
"""Scale of the loss where keypoints are not refined, working pixels. They are one or two pixels
off, and false matches of a former model much further."""
POSSIBLE = (0.1, 10.0, 1.0)
"""What COLMAP's mapper takes for a lens: the least and the largest focal length, in units of the
longer side, and the largest distortion. One photo of *statue* with a camera of its own ended with a
focal length of -756 pixels."""


def bundle_adjust(
    reconstruction: pycolmap.Reconstruction,
    *,
    loss_px: float,
    refine_intrinsics: bool,
    threads: int,
    steps: int = 300,
    held: Collection[int] = (),
) -> None:
    """Adjust all poses and points of a model, in place (`adjusted`).

    The core's program knows neither rigs of several cameras nor some of COLMAP's camera models, and
    is slow for very many photos (`adjustable`). Such models are adjusted by COLMAP.
    """
    how = {"loss_px": loss_px, "refine_intrinsics": refine_intrinsics}
    model = Model.from_colmap(reconstruction, stored_sizes(reconstruction))
    if has_rigs(reconstruction) or not adjustable(model, refine_intrinsics=refine_intrinsics):
        _by_colmap(reconstruction, threads=threads, steps=steps, held=held, **how)
        views = Model.from_colmap(reconstruction, model.sizes).views
        metric = gives_scale(reconstruction, held)
        move_model(reconstruction, *_back(views, model.views, metric=metric))
    else:
        write_into(adjusted_onto(model, None, steps=steps, **how), reconstruction)
        return
    forget_behind(reconstruction)


def adjusted(
    model: Model,
    *,
    loss_px: float,
    refine_intrinsics: bool,
    threads: int,
    steps: int = 300,
    held: Collection[int] = (),
) -> Model:
    """A model with the poses, points and cameras that its observations speak for.

    Observations of points that end behind a camera are taken out, and so are points with fewer than
    two. The model keeps its size, place and direction as a whole. A camera that ends as no lens can
    be is held, while the rest is adjusted again.

    Args:
      loss_px: scale of the Cauchy loss, original pixels. If it is well above the noise (0.1 px
        after refinement), sound observations count as in least squares, and others count little.
      refine_intrinsics: also adjust focal lengths and distortion, and the principal points of
        cameras that `VIEWS_FOR_CENTRE` views share.
      threads: of COLMAP, if it adjusts the model (`bundle_adjust`); -1 takes all cores.
      steps: the iteration ends after so many, if it has not ended before.
      held: ids of cameras that stay where they are on their rig. Where one of them stands away from
        the centre of its rig, the size of the model follows from the photos.
    """
    how = {"loss_px": loss_px, "refine_intrinsics": refine_intrinsics, "steps": steps}
    if model.rigs or not adjustable(model, refine_intrinsics=refine_intrinsics):
        made = model.to_colmap()
        bundle_adjust(made, threads=threads, held=held, **how)
        return Model.from_colmap(made, model.sizes)
    found = adjusted_onto(model, None, **how)
    tracks = found.tracks.select(np.isfinite(found.errors_px()))
    return found.with_tracks(tracks.select_points(np.flatnonzero(tracks.num_observations() > 1)))


def adjusted_onto(
    model: Model,
    positions: Positions | None,
    *,
    loss_px: float,
    refine_intrinsics: bool,
    steps: int = 300,
) -> Model:
    """The model after one minimisation, or two if it has lost a camera; all observations stay.

    Args:
      model: `adjustable`. With positions it is near them, and the result is in their frame.
      positions: measured ones of its views.
      loss_px, refine_intrinsics, steps: as in `adjusted`.
    """
    before = cameras_of(model)
    views = Counter(view.camera.camera_id for view in model.views)
    moving: dict[int, frozenset[str]] = {}
    for number, camera in before.items():
        names = frozenset(MODELS[camera.model_name].split()) if refine_intrinsics else frozenset()
        moving[number] = names if views[number] >= VIEWS_FOR_CENTRE else names - CENTRE
    found = minimum(model, moving, positions, loss_px=loss_px, steps=steps)
    after, held = cameras_of(found), dict(moving)
    for number, camera in before.items():
        if _impossible(after[number], camera):
            after[number], held[number] = camera, frozenset()
        elif moving[number] > CENTRE and _ran_away(after[number], camera):
            after[number] = _with_centre_of(after[number], camera)
            held[number] = moving[number] - CENTRE
    if held != moving:
        # An impossible camera has drawn its photos with it, so they start again.
        again = {n for n in before if after[n] is before[n]}
        own = zip(found.views, model.views, strict=True)
        views = [old if old.camera.camera_id in again else new for new, old in own]
        start = with_cameras(found.with_views(views), after)
        found = minimum(start, held, positions, loss_px=loss_px, steps=steps)
    return _in_place_of(found, model) if positions is None else found


def write_into(model: Model, reconstruction: pycolmap.Reconstruction) -> None:
    """Give a reconstruction the poses, cameras and points of the model that was read from it. It
    loses the observations of points behind cameras."""
    for view in model.views:
        image = reconstruction.image(view.image_id)
        frame = reconstruction.frame(image.frame_id)
        frame.set_cam_from_world(image.camera_id, view.cam_from_world())
    for number, camera in cameras_of(model).items():
        reconstruction.camera(number).params = camera.params.tolist()
    for number, xyz in zip(sorted(reconstruction.point3D_ids()), model.tracks.points, strict=True):
        reconstruction.point3D(number).xyz = xyz
    forget_behind(reconstruction)


def _back(
    views: list[View], before: list[View], *, metric: bool = False
) -> tuple[float, np.ndarray, np.ndarray]:
    """The scale, the rotation and the translation that give views the size, the place and the
    direction as a whole that they had (`metric`: the scale is 1). The rotation is the one nearest
    to the sum of those of the cameras."""
    both = zip(views, before, strict=True)
    turn = nearest_rotation(np.sum([old.rotation.T @ new.rotation for new, old in both], axis=0))
    middle, size = _place(np.stack([view.centre for view in views]) @ turn.T)
    old_middle, old_size = _place(np.stack([view.centre for view in before]))
    scale = old_size / size if size > 0 and old_size > 0 and not metric else 1.0
    return scale, turn, old_middle - scale * middle


def _place(centres: np.ndarray) -> tuple[np.ndarray, float]:
    """The median of each coordinate, and the median distance from there. A camera that runs away
    does not change them."""
    middle = np.median(centres, axis=0)
    return middle, float(np.median(np.linalg.norm(centres - middle, axis=1)))


def _in_place_of(model: Model, before: Model) -> Model:
    """The model where another one of the same views was (`_back`)."""
    scale, turn, shift = _back(model.views, before.views)
    views = [
        v.at(CameraPose(v.rotation @ turn.T, scale * turn @ v.centre + shift)) for v in model.views
    ]
    points = scale * model.tracks.points @ turn.T + shift
    return model.with_views(views).with_tracks(model.tracks._replace(points=points))


def _impossible(camera: pycolmap.Camera, before: pycolmap.Camera) -> bool:
    """Whether a camera is none that a lens can be, while it was one before."""
    params = np.asarray(camera.params)
    wrong = not np.isfinite(params).all() or camera.has_bogus_params(*POSSIBLE)
    return bool(wrong and not before.has_bogus_params(*POSSIBLE))


def _ran_away(camera: pycolmap.Camera, before: pycolmap.Camera) -> bool:
    """Whether a principal point is too far out, and farther than it was."""
    middle = np.asarray([camera.width, camera.height]) / 2
    now, then = (float(np.linalg.norm(_centre(each) - middle)) for each in (camera, before))
    return now > max(then, FARTHEST_CENTRE * max(camera.width, camera.height))


def _centre(camera: pycolmap.Camera) -> np.ndarray:
    return np.asarray([camera.principal_point_x, camera.principal_point_y])


def _with_centre_of(camera: pycolmap.Camera, other: pycolmap.Camera) -> pycolmap.Camera:
    changed = copy.deepcopy(camera)
    changed.principal_point_x, changed.principal_point_y = _centre(other)
    return changed


def _by_colmap(
    reconstruction: pycolmap.Reconstruction,
    *,
    loss_px: float,
    refine_intrinsics: bool,
    threads: int,
    steps: int,
    held: Collection[int] = (),
) -> None:
    """Adjust a model by COLMAP, in place. Principal points move if all cameras have enough views.
    Cameras that end as no lens can be are held, and the rest is adjusted again."""
    images = [reconstruction.image(i) for i in sorted(reconstruction.reg_image_ids())]
    views, fixed = Counter(image.camera_id for image in images), set[int]()
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = refine_intrinsics
    options.refine_principal_point = refine_intrinsics and min(views.values()) >= VIEWS_FOR_CENTRE
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = steps
    options.ceres.solver_options.function_tolerance = TOLERANCE
    before = {number: copy.deepcopy(reconstruction.camera(number)) for number in views}
    while True:
        config = pycolmap.BundleAdjustmentConfig()
        for image in images:
            config.add_image(image.image_id)
        for number in sorted(fixed):
            config.set_constant_cam_intrinsics(number)
        for number in sorted(held):
            config.set_constant_sensor_from_rig_pose(camera_sensor(number))
        if gives_scale(reconstruction, held):  # two cameras would hold the size, too
            config.set_constant_rig_from_world_pose(images[0].frame_id)
        else:
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        # Not pycolmap.bundle_adjustment: it switches COLMAP's messages on for the whole process.
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
        native(lambda _, solver=adjuster: solver.solve(), "bundle adjustment", grace_s=1)
        after = {number: reconstruction.camera(number) for number in views}
        lost = {
            n
            for n in before.keys() - fixed
            if _impossible(after[n], before[n]) or _ran_away(after[n], before[n])
        }
        if not lost:
            return
        for number in lost:
            after[number].params = before[number].params.tolist()
        fixed |= lost
