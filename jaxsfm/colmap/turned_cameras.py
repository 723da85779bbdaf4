"""The bundle adjustment of photos that one camera took upright and turned.

Photos can share a camera only if they were turned alike: in a turned photo the principal point and
the focal lengths change places. For the last adjustment, all photos are turned upright and back.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
import pycolmap

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.colmap.view import View
from jaxsfm.io.orientation import QUARTERS, UPRIGHT, stored_axes, upright_size


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
