"""The bundle adjustment of a model of arrays, by the core's program.

A program is compiled for sizes of arrays. Arrays here have room for more, so that few programs
serve models of all sizes.
"""

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import pycolmap

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.core.bundle import Adjustment, minimised
from jaxsfm.core.bundle_layout import Free, Layout, is_formed, layout_of, room_for
from jaxsfm.core.bundle_problem import Observations, Poses, Positions, Scene
from jaxsfm.core.cameras import MODELS, WIDTH, intrinsics_of
from jaxsfm.io.photos import Pixels
from jaxsfm.io.traced_programs import Traced

TOLERANCE = 1e-7
"""The iteration ends where a step promises to lower the cost by less than this share."""
FEW_PHOTOS = 128
"""Up to so many photos there is room for the next power of two, so that few programs are compiled.
The matrix of 256 photos takes a tenth of a step, and grows with the cube of their number."""
Moving = Mapping[int, frozenset[str]]
"""By the number of a camera, the names of its parameters that move."""

_minimised = Traced(minimised, Adjustment, Scene, Poses, Observations, Layout, Free, Positions)


def adjustable(model: Model, *, refine_intrinsics: bool) -> bool:
    """Whether the core knows the cameras of a model, and can form its system: above so many photos,
    conjugate gradients take 13 to 16 times as long as COLMAP."""
    cameras = cameras_of(model).values()
    if any(camera.model_name not in MODELS for camera in cameras):
        return False
    columns = max(len(MODELS[camera.model_name].split()) for camera in cameras)
    numbers = _room(len(cameras) + 1) * columns * refine_intrinsics
    rows = model.tracks.view, model.tracks.point
    return is_formed(*rows, len(model.views), numbers=numbers)


def cameras_of(model: Model) -> dict[int, pycolmap.Camera]:
    """The cameras of the views, by their numbers."""
    return {view.camera.camera_id: view.camera for view in model.views}


def with_cameras(model: Model, cameras: Mapping[int, pycolmap.Camera]) -> Model:
    """The model with other cameras of its views."""
    views = [dataclasses.replace(v, camera=cameras[v.camera.camera_id]) for v in model.views]
    return dataclasses.replace(model, views=views, cameras={**model.cameras, **cameras})


def minimum(
    model: Model, moving: Moving, positions: Positions | None = None, *, loss_px: float, steps: int
) -> Model:
    """The model whose poses, points and cameras its observations speak for.

    All observations stay, also of points that end behind a camera. Points with fewer than two stay
    where they are. Nothing but positions says where the model as a whole lies.

    Args:
      model: the core knows its cameras (`adjustable`).
      positions: measured ones of its views, in its frame.
      loss_px: scale of the Cauchy loss, original pixels.
      steps: the iteration ends after so many, if it has not ended before.
    """
    tracks, counts = model.tracks, model.tracks.num_observations()
    kept = np.flatnonzero(counts > 1)
    some = tracks.select_points(kept)
    numbers = sorted(moving)
    free_params, params, kind = _intrinsics(model, moving, numbers)
    start = Scene(_poses(model.views), _homogeneous(some), params)
    photos, points = len(start.poses.rotations), len(start.points)
    moves: tuple[Any, ...] = (
        np.arange(6 * photos).reshape(-1, 6) < 6 * len(model.views),
        np.arange(points) < len(kept),
        free_params,
    )
    free = Free(*moves)  # arrays of numpy, as in a layout
    camera = np.zeros(photos, np.int32)
    camera[: len(model.views)] = [numbers.index(v.camera.camera_id) for v in model.views]
    layout = layout_of(some.view, some.point, free, camera=camera, model=kind, room=True)
    seen: tuple[Any, ...] = np.zeros((layout.photo.size, 2)), np.zeros(layout.photo.size)
    seen[0][: len(some.xy)], seen[1][: len(some.xy)] = _in_original(model.views, some), 1
    limits: tuple[Any, ...] = np.float64(loss_px), np.int32(steps), np.float64(TOLERANCE)
    with jax.enable_x64(True):
        measured = None if positions is None else _with_room(positions, photos)
        done = _minimised(start, Observations(*seen), layout, *limits, measured)
        scene: Any = jax.tree.map(np.asarray, done.scene)
    cameras = cameras_of(model)
    for row, number in enumerate(numbers):
        cameras[number] = copy.deepcopy(cameras[number])
        cameras[number].params = scene.params[row, : len(cameras[number].params)].tolist()
    views = [
        view.at(CameraPose(r, -r.T @ t))
        for view, r, t in zip(model.views, *scene.poses, strict=False)
    ]
    x = scene.points[: len(kept)]
    points = tracks.points.copy()
    points[kept] = x[:, :3] / np.where(x[:, 3] == 0, np.finfo(float).tiny, x[:, 3])[:, None]
    after = model.with_views(views).with_tracks(tracks._replace(points=points))
    return with_cameras(after, cameras)


def _intrinsics(model: Model, moving: Moving, numbers: list[int]) -> tuple[Any, Any, Any]:
    """Which parameters of cameras move, the parameters, and the cameras' models.

    After the cameras come some that no photo has. The last one lets every number move that any of
    the models has, so that the program does not depend on which of them are held.
    """
    cameras = cameras_of(model)
    names = [cameras[n].model_name for n in numbers]
    none = [names[0]] * (_room(len(names) + 1) - len(names))
    filled = [cameras[n].params.tolist() for n in [*numbers, *numbers[:1] * len(none)]]
    params, kind = intrinsics_of(names + none, filled)
    free = np.zeros((len(params), WIDTH), bool)
    for row, number in enumerate(numbers):
        for column, name in enumerate(MODELS[names[row]].split()):
            free[row, column] = name in moving[number]
            free[-1, column] |= bool(moving[number])
    return free, params, kind


def _poses(views: list[View]) -> Poses:
    """Poses of views, and after them the world's."""
    room = _room(len(views), parts=4 if len(views) > FEW_PHOTOS else 1)
    rotations, translations = np.tile(np.eye(3), (room, 1, 1)), np.zeros((room, 3))
    for k, view in enumerate(views):
        rotations[k], translations[k] = view.rotation, -view.rotation @ view.centre
    given: tuple[Any, ...] = rotations, translations
    return Poses(*given)


def _with_room(positions: Positions, room: int) -> Positions:
    """Positions of views, and after them some that were not measured."""
    more = room - len(positions.weight)
    given: tuple[Any, ...] = np.pad(positions.xyz, ((0, more), (0, 0))), positions.weight
    return Positions(given[0], np.pad(given[1], (0, more)), np.float64(positions.scale))  # pyright: ignore


def _homogeneous(tracks: Tracks) -> Any:
    """Points (n, 4), and some after them, at least one for each two rows that there is room for."""
    points = np.tile([0.0, 0.0, 1.0, 1.0], (room_for(len(tracks.point)) // 2, 1))
    points[: len(tracks.points), :3] = tracks.points
    return points


def _room(count: int, parts: int = 1) -> int:
    """The next of the numbers that divide each doubling into so many parts."""
    step = max(2 ** ((count - 1).bit_length() - 1) // parts, 1)
    return max(-(-count // step) * step, 1)


def _in_original(views: list[View], tracks: Tracks) -> np.ndarray:
    """Keypoints (n, 2) in COLMAP's pixels."""
    scales = np.asarray([view.pixels.scale for view in views])
    return Pixels((1.0, 1.0)).to_colmap(tracks.xy) * scales[tracks.view]
