"""A COLMAP model as arrays and back: views, tracks, bundle adjustment.

Arrays use this package's pixels of the *working* images; COLMAP's half pixel and the resizing are
undone and redone here.
"""

import dataclasses
from collections.abc import Collection, Mapping
from typing import NamedTuple

import cv2  # noqa: F401  before pycolmap: see jaxsfm.colmap.database
import numpy as np
import pycolmap

from jaxsfm.colmap.native import native

MIN_TRI_ANGLE_DEG = 1.5
"""COLMAP's."""
Sizes = Mapping[str, tuple[tuple[int, int], tuple[float, float]]]
"""Image name -> working (width, height) and original pixels per working pixel."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """A registered image."""

    image_id: int
    name: str
    rotation: np.ndarray
    """float64 (3, 3), world to camera."""
    centre: np.ndarray
    """float64 (3,)."""
    camera: pycolmap.Camera
    scale: np.ndarray
    """Original pixels per working pixel, (x, y)."""
    size: tuple[int, int]
    """(width, height) of the working image."""

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Working pixels (n, 2) and depth (n,) of world points (n, 3); NaN pixels behind it."""
        local = (points - self.centre) @ self.rotation.T
        depth = local[:, 2]
        front = depth > 0
        xy = np.full((len(points), 2), np.nan)
        if front.any():
            xy[front] = self.camera.img_from_cam(np.ascontiguousarray(local[front]))
        return xy / self.scale - 0.5, depth

    def cam_from_world(self) -> pycolmap.Rigid3d:
        """The pose as COLMAP has it."""
        turned = pycolmap.Rotation3d(self.rotation)
        return pycolmap.Rigid3d(turned, -self.rotation @ self.centre)

    def rays(self, xy: np.ndarray) -> np.ndarray:
        """World directions (n, 3) of working pixels, of depth 1."""
        flat = self.camera.cam_from_img(np.ascontiguousarray((xy + 0.5) * self.scale))
        assert flat is not None
        return np.c_[flat, np.ones(len(flat))] @ self.rotation


class Tracks(NamedTuple):
    """Points and where the views see them; observation k is of `point[k]` in `view[k]`."""

    points: np.ndarray
    """float64 (n, 3)."""
    point: np.ndarray
    """int (m,): index into `points`."""
    view: np.ndarray
    """int (m,): index into the views."""
    xy: np.ndarray
    """float64 (m, 2), working pixels of the view."""


def read_model_arrays(
    model: pycolmap.Reconstruction,
    sizes: Sizes,
) -> tuple[list[View], Tracks]:
    """Views (by image id) and tracks (by point id) of a model."""
    views, index, pixels = [], {}, []
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        size, scale = sizes[image.name]
        index[image_id] = len(views)
        views.append(
            View(
                image_id=image_id,
                name=image.name,
                rotation=image.cam_from_world().rotation.matrix(),
                centre=np.asarray(image.projection_center()),
                camera=model.camera(image.camera_id),
                scale=np.asarray(scale, np.float64),
                size=size,
            )
        )
        xy = np.asarray([p.xy for p in image.points2D], np.float64).reshape(-1, 2)
        pixels.append(xy / np.asarray(scale) - 0.5)
    ids = sorted(model.point3D_ids())
    points = np.asarray([model.point3D(i).xyz for i in ids], np.float64).reshape(-1, 3)
    rows = np.asarray(
        [
            (k, index[e.image_id], e.point2D_idx)
            for k, i in enumerate(ids)
            for e in model.point3D(i).track.elements
        ],
        np.int64,
    ).reshape(-1, 3)
    xy = np.empty((len(rows), 2))
    for k, at in enumerate(pixels):
        own = rows[:, 1] == k
        xy[own] = at[rows[own, 2]]
    return views, Tracks(points, rows[:, 0], rows[:, 1], xy)


def point_colours(model: pycolmap.Reconstruction) -> np.ndarray:
    """uint8 (n, 3), RGB, of the points in the order of `read_model_arrays`."""
    ids = sorted(model.point3D_ids())
    return np.asarray([model.point3D(i).color for i in ids], np.uint8).reshape(-1, 3)


def errors_px(views: list[View], tracks: Tracks) -> np.ndarray:
    """Reprojection error of every observation, working pixels; infinite behind the camera."""
    errors = np.empty(len(tracks.xy))
    for k, view in enumerate(views):
        rows = np.flatnonzero(tracks.view == k)
        at, _ = view.project(tracks.points[tracks.point[rows]])
        errors[rows] = np.linalg.norm(at - tracks.xy[rows], axis=1)
    return np.where(np.isfinite(errors), errors, np.inf)


def select(tracks: Tracks, keep: np.ndarray) -> Tracks:
    """The tracks with only those observations; points stay."""
    return Tracks(tracks.points, tracks.point[keep], tracks.view[keep], tracks.xy[keep])


def part_of(
    views: list[View], tracks: Tracks, names: Collection[str]
) -> tuple[list[View], Tracks, np.ndarray]:
    """Some views of a model, the points that they see, and which those are."""
    chosen = [k for k, view in enumerate(views) if view.name in names]
    place = np.full(len(views), -1)
    place[chosen] = np.arange(len(chosen))
    rows = np.flatnonzero(place[tracks.view] >= 0)
    point, index = np.unique(tracks.point[rows], return_inverse=True)
    part = Tracks(tracks.points[point], index, place[tracks.view[rows]], tracks.xy[rows])
    return [views[k] for k in chosen], part, point


def build_model(
    template: pycolmap.Reconstruction, views: list[View], tracks: Tracks
) -> pycolmap.Reconstruction:
    """A model with the cameras of `template` and these views and tracks.

    A view's own camera counts where it differs from the template's. Points with fewer than two
    observations, or with rays closer than 1.5 degrees, are left out.
    """
    model = pycolmap.Reconstruction()
    cameras = {i: template.camera(i) for i in template.cameras}
    cameras |= {view.camera.camera_id: view.camera for view in views}
    for camera_id in sorted(cameras):
        model.add_camera_with_trivial_rig(cameras[camera_id])
    place = np.zeros(len(tracks.xy), np.int64)
    for k, view in enumerate(views):
        rows = np.flatnonzero(tracks.view == k)
        place[rows] = np.arange(len(rows))
        image = pycolmap.Image(
            name=view.name,
            camera_id=view.camera.camera_id,
            image_id=view.image_id,
            keypoints=(tracks.xy[rows] + 0.5) * view.scale,
        )
        model.add_image_with_trivial_frame(image, view.cam_from_world())
    order = np.argsort(tracks.point, kind="stable")
    ends = np.searchsorted(tracks.point[order], np.arange(len(tracks.points) + 1))
    for k, xyz in enumerate(tracks.points):
        rows = order[ends[k] : ends[k + 1]]
        if len(rows) < 2:
            continue
        track = pycolmap.Track()
        for row in rows:
            track.add_element(views[tracks.view[row]].image_id, int(place[row]))
        model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    pycolmap.ObservationManager(model).filter_all_points3D(1e9, MIN_TRI_ANGLE_DEG)
    return model


def bundle_adjust(
    model: pycolmap.Reconstruction,
    *,
    loss_px: float,
    refine_intrinsics: bool,
    threads: int,
) -> None:
    """Bundle adjustment of everything, in place.

    Args:
      loss_px: scale of the Cauchy loss, original pixels. Well above the noise (0.1 px
        after refinement) it is least squares for what is sound, and still robust.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = refine_intrinsics
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-7
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not pycolmap.bundle_adjustment: it switches COLMAP's log messages on for the whole process.
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    native(lambda _: adjuster.solve(), "bundle adjustment", grace_s=1)
    model.update_point_3d_errors()  # the solver leaves them as they were
