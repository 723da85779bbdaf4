"""Whether the photos of a model speak for another camera than the one that was held.

A known camera is not adjusted. If it is not the camera of the photos, the model is bent so that it
fits all the same: the reprojection error hardly shows it. So the camera is adjusted twice more, on
copies of the model, each with one half of the points. The halves know nothing of each other. If
they agree on a camera, and it is not the one that was held, the photos speak for it.
"""

import copy
import dataclasses
import math

import numpy as np
import pycolmap

from jaxsfm.colmap.bundle_adjustment import VIEWS_FOR_CENTRE, bundle_adjust
from jaxsfm.colmap.poses import nearest_rotation

OTHER = 1 / 500
"""A camera is another one if it moves pixels by so much, in units of the longer side of a photo.
The camera of Strecha's sets moves by at most 0.0009, and that of *kitchen*, which is the maker's
figure for all cameras of its kind, by 0.006 to 0.007 (docs/decisions/photos.md)."""
AGREEMENT = 4.0
"""It must move pixels by so many times the distance of the two halves: 10 in *kitchen*."""
STEPS = 10
"""Of the solver. The first ones find the camera."""
GRID = 21
"""Cameras are compared at so many columns and rows of pixels."""
WITH_DISTORTION = pycolmap.CameraModelId.OPENCV
UNDISTORTED = ("SIMPLE_PINHOLE", "PINHOLE")
"""Models of cameras without distortion, which get one: a known camera may lack it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OtherCamera:
    """A camera that the photos of a model speak for, instead of the one that was held."""

    model: str
    """The name of COLMAP's camera model."""
    params: list[float]
    """Its parameters, COLMAP's pixels."""
    distance_px: float
    """How far it moves a pixel: root mean square over the photo, after the rotation that fits
    best."""
    halves_px: float
    """The same distance between the cameras that each half of the points speaks for."""

    def as_option(self) -> str:
        """The camera as a value of `--intrinsics`."""
        return f"{self.model}:" + ",".join(f"{value:.6g}" for value in self.params)

    def in_words(self) -> str:
        """What was found, and what to do."""
        return (
            f"the photos speak for another one, {self.as_option()}. It moves their pixels by "
            f"{self.distance_px:.1f} px, and two halves of the points agree on it to "
            f"{self.halves_px:.1f} px. --refine-intrinsics yes adjusts the camera; with this one "
            "as --intrinsics, it starts nearer"
        )


def other_camera(model: pycolmap.Reconstruction, *, threads: int) -> OtherCamera | None:
    """The camera that the photos speak for, if it is not that of the model.

    Models with several cameras, or with fewer photos than determine one, are not looked at.

    Args:
      model: it was adjusted with a camera that was held. It is not changed.
      threads: of the solver; -1 takes all cores.
    """
    if len(model.cameras) != 1 or model.num_reg_images() < VIEWS_FOR_CENTRE:
        return None
    (held,) = model.cameras.values()
    halves = []
    for half in (_half(model, 0), _half(model, 1)):
        bundle_adjust(half, loss_px=1.0, refine_intrinsics=True, threads=threads, steps=STEPS)
        (camera,) = half.cameras.values()
        halves.append(copy.deepcopy(camera))  # the model that holds it goes
    found = _between(*halves)
    distance, spread = camera_distance(held, found), camera_distance(*halves)
    if not math.isfinite(distance + spread):  # the adjustment has left what a lens can be
        return None
    if distance < max(OTHER * max(held.width, held.height), AGREEMENT * spread):
        return None
    return OtherCamera(
        model=found.model_name,
        params=[float(value) for value in found.params],
        distance_px=distance,
        halves_px=spread,
    )


def camera_distance(first: pycolmap.Camera, second: pycolmap.Camera) -> float:
    """How far apart two cameras of photos of one size see the same, pixels.

    A pixel of the first camera is a direction, which the second one sees at another pixel. The
    directions are turned so that they fit best, for the poses of a model absorb a rotation.

    Returns:
      the root mean square of the distances over the photo; infinite if one of the cameras sees
      nothing at some pixels, because its distortion folds there.
    """
    columns, rows = (np.linspace(0, side, GRID) for side in (first.width, first.height))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    a, b = (_directions(camera, pixels) for camera in (first, second))
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return math.inf
    turn = nearest_rotation(b.T @ a)
    seen = np.asarray(second.img_from_cam(a @ turn.T))
    apart = float(np.sqrt(np.square(seen - pixels).sum(axis=1).mean()))
    return apart if math.isfinite(apart) else math.inf


def _directions(camera: pycolmap.Camera, pixels: np.ndarray) -> np.ndarray:
    plane = np.asarray(camera.cam_from_img(pixels))
    rays = np.concatenate([plane, np.ones((len(pixels), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _half(model: pycolmap.Reconstruction, part: int) -> pycolmap.Reconstruction:
    """A copy of a model that has every second point, the first ones or the others, with a camera
    that can be adjusted."""
    half = pycolmap.Reconstruction(model)
    for k, number in enumerate(sorted(half.points3D)):
        if k % 2 != part:
            half.delete_point3D(number)
    (camera,) = half.cameras.values()
    if camera.model_name in UNDISTORTED:
        focal, centre = camera.params[: len(camera.focal_length_idxs())], camera.params[-2:]
        camera.model = WITH_DISTORTION
        camera.params = [focal[0], focal[-1], *centre, 0.0, 0.0, 0.0, 0.0]
    return half


def _between(first: pycolmap.Camera, second: pycolmap.Camera) -> pycolmap.Camera:
    """The camera with the mean parameters of two."""
    mean = copy.deepcopy(first)
    mean.params = [(a + b) / 2 for a, b in zip(first.params, second.params, strict=True)]
    return mean
