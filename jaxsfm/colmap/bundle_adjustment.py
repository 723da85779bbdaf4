"""COLMAP's bundle adjustment of a whole model.

COLMAP can share a camera only among photos that were turned alike: the principal point of a turned
photo lies elsewhere, and its two focal lengths change places. For the last adjustment, all photos
of such a model are turned upright, where they do share it, and are turned back afterwards.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.colmap.native import native
from jaxsfm.colmap.reconstruction import move_model
from jaxsfm.colmap.view import View
from jaxsfm.io.orientation import QUARTERS, UPRIGHT, stored_axes, upright_size

VIEWS_FOR_CENTRE = 3
"""The principal point of a camera is adjusted if so many views of the model share it. In a single
view it cannot be told from a small rotation. Of all three neighbours of Herz-Jesus-P8 and of
fountain-P11, the median rotation is off by 0.16 and 0.27 deg instead of 0.47 and 0.60, and the
worst by 0.33 and 0.89 deg instead of 1.14 and 1.29. All eight views of Herz-Jesus-P8 find the point
to 0.4 px, which was 8 px from the centre of the photos."""
TRUST_RADIUS = 1e8
"""The radius of the first step of the solver; that of Ceres is 1e4. It holds long rows of photos
back: bending them changes the errors little. With 1e10, a row of 300 photos that was joined from
five parts takes 2.5 s; with 1e4 it takes 15 s to get as far. 1e8 was not measured on it. A step
that is too long is taken back."""
FARTHEST_CENTRE = 0.1
"""A principal point that moves farther than this from the centre of the photo, in units of the
longer side, is not believed."""


def bundle_adjust(
    reconstruction: pycolmap.Reconstruction,
    *,
    loss_px: float,
    refine_intrinsics: bool,
    threads: int,
    steps: int = 50,
) -> None:
    """Adjust all poses and points of a model, in place.

    Observations of points that end behind a camera are taken out. The model keeps its size and its
    place: the solver holds two cameras, and in a video they may be a millimetre apart. All 500
    frames of *kitchen* were a hundred thousand units wide after three passes.

    Args:
      loss_px: scale of the Cauchy loss, original pixels. If it is well above the noise (0.1 px
        after refinement), sound observations count as in least squares, and others count little.
      refine_intrinsics: also adjust focal lengths and distortion, and the principal points of
        cameras that `VIEWS_FOR_CENTRE` views share.
      threads: of the solver; -1 takes all cores.
      steps: the solver ends after so many, if it has not ended before.
    """
    images = (reconstruction.image(i) for i in reconstruction.reg_image_ids())
    views = Counter(image.camera_id for image in images)
    shared = {camera for camera, count in views.items() if count >= VIEWS_FOR_CENTRE}
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = refine_intrinsics
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = steps
    options.ceres.solver_options.function_tolerance = 1e-7
    options.ceres.solver_options.initial_trust_region_radius = TRUST_RADIUS
    before = {number: _centre(reconstruction.camera(number)) for number in sorted(shared)}
    place = _place(reconstruction)
    options.refine_principal_point = refine_intrinsics and shared == views.keys()
    _solve(reconstruction, options, fixed=())
    if refine_intrinsics and shared and not options.refine_principal_point:
        options.refine_principal_point = True  # COLMAP has one switch for all cameras
        _solve(reconstruction, options, fixed=sorted(views.keys() - shared))
    lost = [n for n in before if _ran_away(reconstruction.camera(n), before[n])]
    for number in lost:
        camera = reconstruction.camera(number)
        camera.principal_point_x, camera.principal_point_y = before[number]
    if lost:
        options.refine_principal_point = False
        _solve(reconstruction, options, fixed=())
    # The solver moves points behind cameras. COLMAP gives them an error of 1e154.
    pycolmap.ObservationManager(reconstruction).filter_observations_with_negative_depth()
    _move_to(reconstruction, place)
    reconstruction.update_point_3d_errors()  # the solver does not update them


class _Place(NamedTuple):
    """Where most cameras of a model are. A camera that runs away does not change it."""

    middle: np.ndarray
    """The median of each coordinate, float64 (3,)."""
    size: float
    """The median distance from the middle."""


def _place(reconstruction: pycolmap.Reconstruction) -> _Place:
    numbers = sorted(reconstruction.reg_image_ids())
    centres = np.stack([reconstruction.image(n).projection_center() for n in numbers])
    middle = np.median(centres, axis=0)
    return _Place(middle, float(np.median(np.linalg.norm(centres - middle, axis=1))))


def _move_to(reconstruction: pycolmap.Reconstruction, place: _Place) -> None:
    """Give a model the size and the place that it had; it is not turned."""
    now = _place(reconstruction)
    if not (now.size > 0 and place.size > 0):
        return
    scale = place.size / now.size
    shift = place.middle - scale * now.middle
    move_model(reconstruction, scale, np.eye(3), shift)


def _centre(camera: pycolmap.Camera) -> tuple[float, float]:
    return camera.principal_point_x, camera.principal_point_y


def _ran_away(camera: pycolmap.Camera, before: tuple[float, float]) -> bool:
    """Whether a principal point is too far out, and farther than it was."""
    middle = camera.width / 2, camera.height / 2
    now, then = math.dist(_centre(camera), middle), math.dist(before, middle)
    return now > max(then, FARTHEST_CENTRE * max(camera.width, camera.height))


def _solve(
    reconstruction: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    *,
    fixed: Iterable[int],
) -> None:
    """Adjust a model; the intrinsics of `fixed` cameras stay."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(reconstruction.reg_image_ids()):
        config.add_image(image_id)
    for camera_id in fixed:
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not pycolmap.bundle_adjustment: it switches COLMAP's log messages on for the whole process.
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
    native(lambda _: adjuster.solve(), "bundle adjustment", grace_s=1)


def shares_one_camera(model: pycolmap.Reconstruction, codes: Mapping[str, int]) -> bool:
    """Whether the photos of a model have one camera, but for turns.

    Args:
      codes: how the pixels of each photo were turned (`jaxsfm.io.orientation`).
    """
    images = [model.image(i) for i in model.reg_image_ids()]
    used = {(codes[image.name], image.camera_id) for image in images}
    turns = {code for code, _ in used}
    return len(used) == len(turns) < len(images) and turns <= set(QUARTERS) and turns != {UPRIGHT}


def adjust_as_one(
    model: pycolmap.Reconstruction, codes: Mapping[str, int], *, threads: int
) -> pycolmap.Reconstruction:
    """Adjust a model whose photos share one camera but for turns (`shares_one_camera`).

    Raises UserError if the camera's model is one that cannot be turned.
    """
    stored = Model.from_colmap(model, stored_sizes(model))
    start = max(stored.views, key=lambda view: (codes[view.name] == UPRIGHT, -view.image_id))
    shared = _turned(start.camera, _inverse(codes[start.name]))
    views = [_in_frame(v, shared, _inverse(codes[v.name])) for v in stored.views]
    upright = _moved(stored, views).to_colmap()
    bundle_adjust(upright, loss_px=1.0, refine_intrinsics=True, threads=threads)
    adjusted = Model.from_colmap(upright, {view.name: (view.size, (1.0, 1.0)) for view in views})
    shared = adjusted.views[0].camera
    numbers = {view.name: view.camera.camera_id for view in stored.views}
    back = []
    for view in adjusted.views:
        camera = _turned(shared, codes[view.name])
        camera.camera_id = numbers[view.name]
        back.append(_in_frame(view, camera, codes[view.name]))
    result = _moved(dataclasses.replace(adjusted, cameras=stored.cameras), back).to_colmap()
    result.update_point_3d_errors()
    return result


def _inverse(code: int) -> int:
    """The turn that undoes another one."""
    return QUARTERS[-QUARTERS.index(code) % 4]


def _turned(camera: pycolmap.Camera, code: int) -> pycolmap.Camera:
    """The camera of pixels that become those of another camera when they are turned by a code."""
    size = upright_size((camera.width, camera.height), code)
    known = Intrinsics(model=camera.model_name, params=tuple(camera.params)).turned(size, code)
    turned = known.camera(size)
    turned.camera_id = camera.camera_id
    turned.has_prior_focal_length = camera.has_prior_focal_length
    return turned


def _in_frame(view: View, camera: pycolmap.Camera, code: int) -> View:
    """A view whose pixels are those of a camera that `code` turns to the view's own."""
    size = camera.width, camera.height
    rotation = stored_axes(code) @ view.rotation
    return dataclasses.replace(view, rotation=rotation, camera=camera, size=size)


def _moved(model: Model, views: list[View]) -> Model:
    """The model with other frames of the pixels: observations move as their points' projections."""
    xy = model.tracks.xy.copy()
    for k, (old, new) in enumerate(zip(model.views, views, strict=True)):
        rows = model.tracks.view == k
        turn = new.rotation @ old.rotation.T  # of the axes: it says how the pixels turn
        centre_old, centre_new = (np.asarray(view.size) / 2 - 0.5 for view in (old, new))
        xy[rows] = (xy[rows] - centre_old) @ turn[:2, :2].T + centre_new
    return dataclasses.replace(model.with_views(views), tracks=model.tracks._replace(xy=xy))
