"""One image of a model: its pose and camera, in the pixels of the working image."""

import dataclasses

import numpy as np
import pycolmap

from jaxsfm.colmap.poses import CameraPose
from jaxsfm.io.photos import Pixels


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """An image with a pose and a camera.

    Points of the image are pixels of the working image, where the centre of the top-left pixel is
    (0, 0). COLMAP's camera counts pixels of the photo, from the corner of the top-left pixel.
    """

    image_id: int
    name: str
    rotation: np.ndarray
    """float64 (3, 3), world to camera."""
    centre: np.ndarray
    """float64 (3,), world units."""
    camera: pycolmap.Camera
    pixels: Pixels
    """How the pixels of the working image lie on those of the photo."""
    size: tuple[int, int]
    """(width, height) of the working image."""

    @classmethod
    def without_pose(
        cls,
        name: str,
        image_id: int,
        camera: pycolmap.Camera,
        size: tuple[int, int],
        pixels: Pixels,
    ) -> "View":
        """A view whose pose is not known yet: at the origin, with the axes of the world."""
        return cls(
            image_id=image_id,
            name=name,
            rotation=np.eye(3),
            centre=np.zeros(3),
            camera=camera,
            pixels=pixels,
            size=size,
        )

    @property
    def pose(self) -> CameraPose:
        """Where the camera stands, and how it is turned."""
        return CameraPose(self.rotation, self.centre)

    def at(self, pose: CameraPose) -> "View":
        """The same view with another pose."""
        return dataclasses.replace(self, rotation=pose.rotation, centre=pose.centre)

    @property
    def mean_scale(self) -> float:
        """Original pixels per working pixel, the mean over x and y."""
        return float(np.mean(self.pixels.scale))

    @property
    def focal_px(self) -> float:
        """The focal length in working pixels, the mean over x and y."""
        return self.camera.mean_focal_length() / self.mean_scale

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (n, 3).

        Returns:
          float64 (n, 2) pixels, NaN for points behind the camera; float64 (n,) depths.
        """
        local = (points - self.centre) @ self.rotation.T
        depth = local[:, 2]
        front = depth > 0
        xy = np.full((len(points), 2), np.nan)
        if front.any():
            xy[front] = self.camera.img_from_cam(np.ascontiguousarray(local[front]))
        return self.pixels.from_colmap(xy), depth

    def rays(self, xy: np.ndarray) -> np.ndarray:
        """World directions (n, 3) of the viewing rays of pixels (n, 2), scaled to depth 1."""
        flat = self.camera.cam_from_img(np.ascontiguousarray(self.pixels.to_colmap(xy)))
        assert flat is not None
        return np.c_[flat, np.ones(len(flat))] @ self.rotation

    def cam_from_world(self) -> pycolmap.Rigid3d:
        """The pose as COLMAP writes it."""
        turned = pycolmap.Rotation3d(self.rotation)
        return pycolmap.Rigid3d(turned, -self.rotation @ self.centre)

    def in_octave(self, px: int) -> "View":
        """The same view, with pixels that are `px` times as large."""
        sx, sy = self.pixels.scale
        return dataclasses.replace(
            self,
            pixels=Pixels((sx * px, sy * px)),
            size=(self.size[0] // px, self.size[1] // px),
        )
