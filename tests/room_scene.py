"""A rendered room with exact cameras, points and pixels, as models and tracks."""

from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.bench.synthetic import arc, camera_matrix, render, room
from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose, model_poses
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.photos import Pixels
from jaxsfm.sfm.evaluation import evaluate
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.one_pass import PassSettings
from jaxsfm.sfm.refine.passes import refine_model

SIZE = (480, 360)


class Room(NamedTuple):
    views: list[View]
    images: dict[str, np.ndarray]
    """The grey photo of each view, by name."""
    poses: dict[str, CameraPose]
    points: np.ndarray
    plane: np.ndarray
    """Which plane each point lies on."""
    normals: np.ndarray
    visible: np.ndarray
    """bool (points, views)."""


def camera(size=SIZE) -> pycolmap.Camera:
    k = camera_matrix(size)
    params = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5]
    return pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=size[0], height=size[1], params=params
    )


def view_of(pose: CameraPose, number: int) -> View:
    return View(
        image_id=number + 1,
        name=f"{number}.png",
        rotation=pose.rotation,
        centre=pose.centre,
        camera=camera(),
        pixels=Pixels((1.0, 1.0)),
        size=SIZE,
    )


def hidden(points, own, centre, planes) -> np.ndarray:
    """Whether another plane lies between a camera and each point."""
    ray = points - centre
    covered = np.zeros(len(points), bool)
    for k, plane in enumerate(planes):
        normal = np.cross(plane.right, plane.down)
        depth = ((plane.corner - centre) @ normal) / (ray @ normal)
        offset = centre + depth[:, None] * ray - plane.corner
        a = offset @ plane.right / (plane.right @ plane.right)
        b = offset @ plane.down / (plane.down @ plane.down)
        inside = (a > -0.02) & (a < 1.02) & (b > -0.02) & (b < 1.02)
        covered |= inside & (depth > 0) & (depth < 0.99) & (own != k)
    return covered


def rendered_room() -> Room:
    """Five views of the room, 1250 points on its planes."""
    rng = np.random.default_rng(0)
    planes, poses = room(), arc(5)
    points, plane, normals = [], [], []
    for k, p in enumerate(planes):
        st = rng.uniform(0.03, 0.97, (250, 2))
        points.append(p.corner + st[:, :1] * p.right + st[:, 1:] * p.down)
        plane += [k] * len(st)
        normal = np.cross(p.right, p.down)
        normals += [normal / np.linalg.norm(normal)] * len(st)
    points, plane = np.concatenate(points), np.asarray(plane)
    views = [view_of(pose, k) for k, pose in enumerate(poses)]
    visible = np.zeros((len(points), len(views)), bool)
    images = {}
    for k, view in enumerate(views):
        xy, depth = view.project(points)
        with np.errstate(invalid="ignore"):
            inside = (xy > 1).all(1) & (xy < np.asarray(SIZE) - 2).all(1)
        visible[:, k] = (depth > 0) & inside & ~hidden(points, plane, view.centre, planes)
        rgb = render(planes, poses[k], SIZE).astype(np.float32)
        images[view.name] = rgb @ np.float32([0.299, 0.587, 0.114])
    keep = visible.sum(1) >= 2
    return Room(
        views,
        images,
        {view.name: pose for view, pose in zip(views, poses, strict=True)},
        points[keep],
        plane[keep],
        np.asarray(normals)[keep],
        visible[keep],
    )


def exact_tracks(scene: Room, *, use=None) -> Tracks:
    point, view = np.nonzero(scene.visible if use is None else use)
    xy = np.asarray(
        [
            scene.views[v].project(scene.points[p : p + 1])[0][0]
            for p, v in zip(point, view, strict=True)
        ]
    )
    return Tracks(scene.points, point, view, xy)


def noisy_model(scene: Room, sigma: float, *, use=None) -> pycolmap.Reconstruction:
    """A model whose observations have noise, after bundle adjustment."""
    tracks = exact_tracks(scene, use=use)
    rng = np.random.default_rng(1)
    tracks = tracks._replace(xy=tracks.xy + rng.normal(0, sigma, tracks.xy.shape))
    model = Model(scene.views, tracks).to_colmap()
    if sigma:
        bundle_adjust(model, loss_px=1.0, refine_intrinsics=False, threads=1)
    return model


def exact_model(scene: Room, *, use=None) -> Model:
    """The exact views, points and observations."""
    return Model(scene.views, exact_tracks(scene, use=use))


def arrays(model: pycolmap.Reconstruction, scene: Room) -> Model:
    """A model of the room as arrays."""
    return Model.from_colmap(model, sizes(scene))


def read_of(scene: Room, change=lambda image: image):
    return lambda name: (change(scene.images[name]), (1.0, 1.0))


def images_of(scene: Room, change=lambda image: image) -> DeviceImages:
    return DeviceImages(read_of(scene, change))


def errors(model, scene: Room) -> tuple[float, float]:
    e = evaluate(model_poses(model), scene.poses)
    return e.position["mean"], e.rotation_deg["mean"]


def settings_of(**config) -> PassSettings:
    """Settings of a refinement with exact cameras on one thread."""
    return PassSettings(Refinement(**config), refine_intrinsics=False, threads=1)


def refine(model, scene, change=lambda image: image, **config):
    return refine_model(model, read_of(scene, change), settings_of(**config))


def sizes(scene: Room):
    return {view.name: (SIZE, (1.0, 1.0)) for view in scene.views}


def other_scene(seed: int) -> np.ndarray:
    """A textured photo that shows nothing of the room."""
    noise = np.random.default_rng(seed).normal(0, 60, (SIZE[1] // 4, SIZE[0] // 4))
    return 120 + np.kron(noise, np.ones((4, 4))).astype(np.float32)
