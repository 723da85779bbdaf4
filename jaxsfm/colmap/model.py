"""A COLMAP model as arrays: views, points and observations, read from COLMAP and written to it."""

import dataclasses
import functools
from collections.abc import Collection, Mapping

import numpy as np
import pycolmap

from jaxsfm.colmap.rigs import Rigs, rigs_of_model
from jaxsfm.colmap.tracks import Tracks, grouped
from jaxsfm.colmap.view import View
from jaxsfm.io.photos import Pixels

MIN_TRI_ANGLE_DEG = 1.5
"""The least angle between two rays of a point: that of COLMAP's mapper."""
Sizes = Mapping[str, tuple[tuple[int, int], tuple[float, float]]]
"""Image name -> working (width, height), and original pixels per working pixel, (x, y)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """Views, and points with their observations in these views.

    A model is not changed: operations return another one. All pixels are those of the working
    images (`View.pixels`).
    """

    views: list[View]
    tracks: Tracks
    """Its indices of views are positions in `views`."""
    cameras: Mapping[int, pycolmap.Camera] = dataclasses.field(default_factory=dict)
    """Cameras by id. Where a view has another camera of the same id, the view's is written."""
    rigs: Rigs | None = None
    """The rigs that cameras are mounted on, if any. The model that is written is rigid."""

    @classmethod
    def from_colmap(cls, reconstruction: pycolmap.Reconstruction, sizes: Sizes) -> "Model":
        """Read the registered images (in the order of their ids) and points (likewise).

        Args:
          sizes: of all registered images.
        """
        views, index, pixels = [], {}, []
        for image_id in sorted(reconstruction.reg_image_ids()):
            image = reconstruction.image(image_id)
            size, scale = sizes[image.name]
            index[image_id] = len(views)
            view = View(
                image_id=image_id,
                name=image.name,
                rotation=image.cam_from_world().rotation.matrix(),
                centre=np.asarray(image.projection_center()),
                camera=reconstruction.camera(image.camera_id),
                pixels=Pixels(scale),
                size=size,
            )
            views.append(view)
            xy = np.asarray([p.xy for p in image.points2D], np.float64).reshape(-1, 2)
            pixels.append(view.pixels.from_colmap(xy))
        ids = sorted(reconstruction.point3D_ids())
        points = np.asarray([reconstruction.point3D(i).xyz for i in ids], np.float64)
        rows = np.asarray(
            [
                (k, index[e.image_id], e.point2D_idx)
                for k, i in enumerate(ids)
                for e in reconstruction.point3D(i).track.elements
            ],
            np.int64,
        ).reshape(-1, 3)
        xy = np.empty((len(rows), 2))
        for at, own in zip(pixels, grouped(rows[:, 1], len(views)), strict=True):
            xy[own] = at[rows[own, 2]]
        tracks = Tracks(points.reshape(-1, 3), rows[:, 0], rows[:, 1], xy)
        cameras = {i: reconstruction.camera(i) for i in reconstruction.cameras}
        return cls(views, tracks, cameras, rigs_of_model(reconstruction))

    @functools.cached_property
    def rows(self) -> list[np.ndarray]:
        """For each view the indices of its observations, ascending."""
        return grouped(self.tracks.view, len(self.views))

    @property
    def sizes(self) -> Sizes:
        """Those of its views."""
        return {view.name: (view.size, view.pixels.scale) for view in self.views}

    def to_colmap(self) -> pycolmap.Reconstruction:
        """Write the model as COLMAP's.

        Points with fewer than two observations, or with rays closer than 1.5 degrees, are left
        out. The points have no colours.
        """
        return self.numbered_colmap()[0]

    def numbered_colmap(self) -> tuple[pycolmap.Reconstruction, dict[int, int]]:
        """The same, and the index of a point by its number in COLMAP's model."""
        model = pycolmap.Reconstruction()
        cameras = {**self.cameras, **{view.camera.camera_id: view.camera for view in self.views}}
        mounted = self.rigs.cameras() if self.rigs else set[int]()
        for camera_id in sorted(cameras):
            add = model.add_camera if camera_id in mounted else model.add_camera_with_trivial_rig
            add(cameras[camera_id])
        if self.rigs:
            self.rigs.add_to(model, self.views, [len(rows) for rows in self.rows])
        tracks = self.tracks
        place = np.zeros(len(tracks.xy), np.int64)
        for view, rows in zip(self.views, self.rows, strict=True):
            place[rows] = np.arange(len(rows))
            image = pycolmap.Image(
                name=view.name,
                camera_id=view.camera.camera_id,
                image_id=view.image_id,
                keypoints=view.pixels.to_colmap(tracks.xy[rows]),
            )
            if self.rigs and view.image_id in self.rigs.frames:
                image.frame_id, _ = self.rigs.frames[view.image_id]
                model.add_image(image)
            else:
                model.add_image_with_trivial_frame(image, view.cam_from_world())
        order = np.argsort(tracks.point, kind="stable")
        ends = np.searchsorted(tracks.point[order], np.arange(len(tracks.points) + 1))
        index = {}
        for k, xyz in enumerate(tracks.points):
            rows = order[ends[k] : ends[k + 1]]
            if len(rows) < 2:
                continue
            track = pycolmap.Track()
            for row in rows:
                track.add_element(self.views[tracks.view[row]].image_id, int(place[row]))
            index[model.add_point3D(xyz, track, np.zeros(3, np.uint8))] = k
        pycolmap.ObservationManager(model).filter_all_points3D(1e9, MIN_TRI_ANGLE_DEG)
        return model, index

    def with_views(self, views: list[View]) -> "Model":
        """The same points and observations, with other views."""
        return dataclasses.replace(self, views=views)

    def with_tracks(self, tracks: Tracks) -> "Model":
        """The same views, with other points and observations."""
        return dataclasses.replace(self, tracks=tracks)

    def select(self, keep: np.ndarray) -> "Model":
        """Keep only some observations (a mask or indices). All points and views stay."""
        return self.with_tracks(self.tracks.select(keep))

    def part(self, names: Collection[str]) -> tuple["Model", np.ndarray]:
        """Some of the views and the points that they see.

        Args:
          names: of the views. Names of no view are ignored.

        Returns:
          the smaller model; int (n,), which points of this model its points are.
        """
        chosen = [k for k, view in enumerate(self.views) if view.name in names]
        place = np.full(len(self.views), -1)
        place[chosen] = np.arange(len(chosen))
        seen = self.tracks.select(place[self.tracks.view] >= 0)
        points = np.unique(seen.point)
        tracks = seen._replace(view=place[seen.view]).select_points(points)
        views = [self.views[k] for k in chosen]
        return dataclasses.replace(self, views=views, tracks=tracks), points

    def triangulated(self) -> "Model":
        """The model without points that fewer than two views see, or whose rays are all closer to
        each other than `MIN_TRI_ANGLE_DEG`, as COLMAP measures angles."""
        tracks = self.tracks
        order = np.argsort(tracks.point, kind="stable")
        centres = np.stack([view.centre for view in self.views])[tracks.view[order]]
        rays = centres - tracks.points[tracks.point[order]]
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(float).tiny)
        wide = np.zeros(len(tracks.points), bool)
        for apart in range(1, int(tracks.num_observations().max(initial=1))):
            one, other = order[:-apart], order[apart:]
            same = np.flatnonzero(tracks.point[one] == tracks.point[other])
            cosine = np.abs((rays[same] * rays[same + apart]).sum(1))
            far = same[cosine <= np.cos(np.deg2rad(MIN_TRI_ANGLE_DEG))]
            wide[tracks.point[one[far]]] = True
        return self.with_tracks(tracks.select_points(np.flatnonzero(wide)))

    def in_octave(self, px: int) -> "Model":
        """The same model, with pixels that are `px` times as large."""
        xy = Pixels.octave(px).from_original(self.tracks.xy)
        views = [view.in_octave(px) for view in self.views]
        return dataclasses.replace(self, views=views, tracks=self.tracks._replace(xy=xy))

    def errors_px(self) -> np.ndarray:
        """float64 (m,): the reprojection error of every observation, working pixels.

        The error is infinite where the point lies behind the camera.
        """
        tracks = self.tracks
        errors = np.empty(len(tracks.xy))
        for view, rows in zip(self.views, self.rows, strict=True):
            at, _ = view.project(tracks.points[tracks.point[rows]])
            errors[rows] = np.linalg.norm(at - tracks.xy[rows], axis=1)
        return np.where(np.isfinite(errors), errors, np.inf)


def stored_sizes(model: pycolmap.Reconstruction) -> Sizes:
    """The sizes of a model's photos as they are stored, for working in original pixels."""
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    cameras = {image.name: model.camera(image.camera_id) for image in images}
    return {name: ((c.width, c.height), (1.0, 1.0)) for name, c in cameras.items()}


def point_colours(reconstruction: pycolmap.Reconstruction) -> np.ndarray:
    """uint8 (n, 3): RGB of the points, in the order of `Model.from_colmap`."""
    ids = sorted(reconstruction.point3D_ids())
    return np.asarray([reconstruction.point3D(i).color for i in ids], np.uint8).reshape(-1, 3)
