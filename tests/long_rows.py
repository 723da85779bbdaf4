"""A long row of photos along a wall, with exact points, and the same row bent along an arc."""

import dataclasses

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from jaxsfm.bench.synthetic import camera_matrix
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.io.photos import Pixels
from jaxsfm.sfm.evaluation import evaluate

SIZE, STEP, DEPTH = (320, 240), 1.0, 4.0
NOISE_PX = 0.1


def row(count: int, *, per_photo: int = 30, noise_px: float = NOISE_PX, seed: int = 0) -> Model:
    """Photos along a wall with points before it, each observed where it is, up to the noise."""
    rng = np.random.default_rng(seed)
    k = camera_matrix(SIZE)
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", k[0, 0], *SIZE)
    length = STEP * count
    spread = (length + 4, 4.0, 1.5)
    points = rng.uniform(-0.5, 0.5, (per_photo * count, 3)) * spread + (length / 2, 0, DEPTH)
    views = [
        View(
            image_id=n + 1,
            name=f"{n:03d}.png",
            rotation=Rotation.from_euler("xyz", rng.normal(0, 2, 3), degrees=True).as_matrix(),
            centre=np.asarray([STEP * n, *rng.uniform(-0.3, 0.3, 2)]),
            camera=camera,
            pixels=Pixels((1.0, 1.0)),
            size=SIZE,
        )
        for n in range(count)
    ]
    parts = []
    for n, view in enumerate(views):
        xy, depth = view.project(points)
        rows = np.flatnonzero(((xy > 0) & (xy < np.asarray(SIZE) - 1)).all(1) & (depth > 0))
        noisy = xy[rows] + rng.normal(0, noise_px, (len(rows), 2))
        parts.append((rows, np.full(len(rows), n), noisy))
    point, view, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    seen = np.bincount(point, minlength=len(points)) >= 2
    tracks = Tracks(points, point, view, xy).select_points(np.flatnonzero(seen))
    return Model(views, tracks, {1: camera})


def bent(model: Model, degrees: float) -> Model:
    """The row along an arc: what it shows hardly changes from photo to photo."""
    length = model.views[-1].centre[0]
    radius = length / np.radians(degrees)

    def turn(x: float) -> np.ndarray:
        return Rotation.from_rotvec([0, x / radius, 0]).as_matrix()

    def moved(at: np.ndarray) -> np.ndarray:
        middle = np.asarray([0, 0, -radius])
        return turn(at[0]) @ (np.asarray([0, at[1], at[2]]) - middle) + middle

    views = [
        dataclasses.replace(v, rotation=v.rotation @ turn(v.centre[0]).T, centre=moved(v.centre))
        for v in model.views
    ]
    points = np.stack([moved(point) for point in model.tracks.points])
    return Model(views, model.tracks._replace(points=points), model.cameras)


def off(model: Model, truth: Model) -> float:
    """The mean error of the positions, in units of the row."""
    found, right = (
        {view.name: CameraPose(view.rotation, view.centre) for view in each.views}
        for each in (model, truth)
    )
    return evaluate(found, right).position["mean"]
