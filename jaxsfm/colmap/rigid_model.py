"""Models that were mapped photo by photo are put on their rigs.

COLMAP's mapper starts from one pair of photos, whose distance it takes for 1. A rig whose base is
known in metres does not fit that, and COLMAP maps no rig with a camera whose place is not known. So
photos are mapped alone first, as COLMAP's own tools do it:

1. Known bases say how long the model's unit is: the median over pairs of photos of a frame.
2. A camera whose place is not known gets the median of its places in all frames, relative to the
   cameras whose place is known.
3. Each frame stands where its photo with most points says. Its other photos follow, also those that
   the mapper has not registered.
4. The model is adjusted with rigid rigs. Observations that do not fit are taken out, and the rest
   is adjusted again.
"""

import copy
import dataclasses
import itertools
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.bundle_adjustment import UNREFINED_LOSS_PX, bundle_adjust
from jaxsfm.colmap.database import camera_sensor, read_images
from jaxsfm.colmap.given_model import has_rigs
from jaxsfm.colmap.map_options import MapOptions, incremental_options
from jaxsfm.colmap.model import MIN_TRI_ANGLE_DEG, Model, stored_sizes
from jaxsfm.colmap.poses import CameraPose, nearest_rotation
from jaxsfm.colmap.reconstruction import ordered
from jaxsfm.colmap.rigs import Rigs, rigs_of_database
from jaxsfm.colmap.view import View
from jaxsfm.errors import UserError
from jaxsfm.io.photos import Pixels

logger = logging.getLogger("jaxsfm")

FITTING_SHARE = 0.25
"""The photos speak against a rig on which less of a camera's observations stay: a pass of the
refinement is taken back if it keeps less of the points."""


def rigid_models(
    models: Sequence[pycolmap.Reconstruction], database: Path, options: MapOptions
) -> list[pycolmap.Reconstruction]:
    """The models on the rigs of a database, the one with most images first.

    Models that have rigs already stay, and so do all if the database has no rigs.

    Raises:
      UserError: no model can be put on the rigs.
    """
    rigs = rigs_of_database(database)
    if rigs is None:
        return list(models)
    made, faults = list[pycolmap.Reconstruction](), list[str]()
    for model in models:
        try:
            made.append(model if has_rigs(model) else _rigid(model, rigs, database, options))
        except _DoesNotFitError as error:
            faults.append(str(error))
    for fault in faults if made else ():
        logger.warning("a model of few photos is left out: %s", fault)
    if faults and not made:
        raise UserError(f"--rig: {faults[0]}")
    return ordered(made)


class _DoesNotFitError(Exception):
    """Why a model cannot be put on its rigs, in words."""


def _rigid(
    model: pycolmap.Reconstruction, rigs: Rigs, database: Path, options: MapOptions
) -> pycolmap.Reconstruction:
    free = Model.from_colmap(model, stored_sizes(model))
    images = read_images(database)
    names = {image_id: name for name, (image_id, _) in images.items()}
    frames = _frames(free.views, rigs)
    scale = _metres_per_unit(frames, rigs)
    views = [view.at(CameraPose(view.rotation, scale * view.centre)) for view in free.views]
    rigs = with_estimated_places(_frames(views, rigs), rigs, names)
    points = free.tracks.points * scale
    scaled = dataclasses.replace(
        free.with_views(views), tracks=free.tracks._replace(points=points), rigs=rigs
    )

    def view_of(image_id: int) -> View:
        _, camera = images[names[image_id]]
        size = camera.width, camera.height
        # The model's camera is the better one.
        camera = free.cameras.get(camera.camera_id, camera)
        return View.without_pose(names[image_id], image_id, camera, size, Pixels((1.0, 1.0)))

    whole = with_frame_mates(scaled, view_of)
    cameras = {camera.camera_id: camera for _, camera in images.values()} | dict(free.cameras)
    made = dataclasses.replace(whole, cameras=cameras).to_colmap()
    limit = incremental_options(options).mapper.filter_max_reproj_error
    for _ in range(2):
        bundle_adjust(
            made,
            loss_px=UNREFINED_LOSS_PX * options.scale,
            refine_intrinsics=options.refine_intrinsics,
            threads=options.threads,
            held=options.held,
        )
        pycolmap.ObservationManager(made).filter_all_points3D(limit, MIN_TRI_ANGLE_DEG)
        made.update_point_3d_errors()
    before, after = (_observations_by_camera(each) for each in (model, made))
    for camera_id, count in sorted(before.items()):
        if after[camera_id] < FITTING_SHARE * count and camera_id in rigs.cameras():
            one = min(i.name for i in model.images.values() if i.camera_id == camera_id)
            raise _DoesNotFitError(
                f"only {after[camera_id]} of {count} observations of the camera of {one} fit its "
                "rig; see whether poses and prefixes are those of the photos"
            )
    return made


def _observations_by_camera(model: pycolmap.Reconstruction) -> Counter[int]:
    found = Counter[int]()
    for image in model.images.values():
        found[image.camera_id] += image.num_points3D
    return found


def _frames(views: Iterable[View], rigs: Rigs) -> list[tuple[int, list[View]]]:
    """The rig and the views of each frame."""
    found: dict[tuple[int, int], list[View]] = {}
    for view in views:
        if view.image_id in rigs.frames:
            found.setdefault(rigs.frames[view.image_id], []).append(view)
    return [(rig_id, own) for (_, rig_id), own in sorted(found.items())]


def _mount(view: View, rig_id: int, rigs: Rigs) -> CameraPose | None:
    """The pose of a camera in the axes of its rig; None if it is not known."""
    pose = rigs.cam_from_rig(view.camera.camera_id, rig_id)
    if pose is None:
        return None
    rotation = pose.rotation.matrix()
    return CameraPose(rotation, -rotation.T @ pose.translation)


def _metres_per_unit(frames: Sequence[tuple[int, list[View]]], rigs: Rigs) -> float:
    """How many metres a unit of the model is: 1 if no rig of the model says how long it is."""
    ratios, metric = list[float](), False
    for rig_id, views in frames:
        sensors = rigs.rigs[rig_id].sensor_ids()
        poses = [rigs.cam_from_rig(sensor.id, rig_id) for sensor in sensors]
        metric |= any(pose is not None and bool(np.any(pose.translation)) for pose in poses)
        places = [(view, _mount(view, rig_id, rigs)) for view in views]
        for (a, in_a), (b, in_b) in itertools.combinations(places, 2):
            if in_a is None or in_b is None:
                continue
            known = float(np.linalg.norm(in_a.centre - in_b.centre))
            apart = float(np.linalg.norm(a.centre - b.centre))
            if known > 0 and apart > 0:
                ratios.append(known / apart)
    if metric and not ratios:
        raise _DoesNotFitError(
            "no frame has two photos in one model whose distance is known, so the model cannot be "
            "put on its rig"
        )
    return float(np.median(ratios)) if ratios else 1.0


def with_estimated_places(
    frames: Sequence[tuple[int, list[View]]], rigs: Rigs, names: dict[int, str]
) -> Rigs:
    """The rigs with a place for each camera that had none.

    The median of the rotation matrices, coordinate by coordinate, and that of the translations are
    not drawn by fewer than half of the frames. The adjustment that follows makes them exact.

    Args:
      frames: the rig of each frame, and its views with a pose, in the unit of the rigs.
      names: of the images, by id.
    """
    rigs = rigs._replace(rigs=copy.deepcopy(dict(rigs.rigs)))
    while True:
        found: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
        for rig_id, views in frames:
            places = [(view, _mount(view, rig_id, rigs)) for view in views]
            for one, none in places:
                for other, mount in places:
                    if none is not None or mount is None:
                        continue
                    turn = one.rotation @ other.rotation.T @ mount.rotation
                    own = other.rotation.T @ mount.rotation
                    centre = other.centre - own @ mount.centre  # of the rig
                    shift = one.rotation @ (centre - one.centre)
                    found.setdefault((rig_id, one.camera.camera_id), []).append((turn, shift))
        if not found:
            break
        (rig_id, camera_id), each = max(found.items(), key=lambda item: len(item[1]))
        turns, shifts = (np.median(np.stack(part), axis=0) for part in zip(*each, strict=True))
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(nearest_rotation(turns)), shifts)
        rigs.rigs[rig_id].set_sensor_from_rig(camera_sensor(camera_id), pose)
    used = {rig_id for rig_id, _ in frames}
    for rig_id, rig in rigs.rigs.items():
        for sensor in rig.sensor_ids():
            if rig_id in used and rigs.cam_from_rig(sensor.id, rig_id) is None:
                of_camera = min(names[i] for i, (_, r) in rigs.frames.items() if r == rig_id)
                raise _DoesNotFitError(
                    f"where a camera of the rig of {of_camera} is mounted cannot be estimated, as "
                    "no model has its photos together with others of their frames"
                )
    return rigs


def with_frame_mates(model: Model, view_of: Callable[[int], View]) -> Model:
    """A rigid model, in which all photos of its frames have a pose.

    Args:
      view_of: gives a photo without a pose, by its image id.
    """
    rigs = model.rigs
    if rigs is None:
        return model
    counts = [len(rows) for rows in model.rows]
    best: dict[tuple[int, int], int] = {}
    for k, view in enumerate(model.views):
        frame = rigs.frames.get(view.image_id)
        if frame is not None and (frame not in best or counts[k] > counts[best[frame]]):
            best[frame] = k
    there = {view.image_id: view for view in model.views}
    mates = sorted(i for i, frame in rigs.frames.items() if frame in best and i not in there)
    views = []
    for view in [*model.views, *map(view_of, mates)]:
        frame = rigs.frames.get(view.image_id)
        if frame is None:
            views.append(view)
            continue
        shown = model.views[best[frame]]
        base, mount = (_mount(each, frame[1], rigs) for each in (shown, view))
        assert base is not None and mount is not None
        turn = base.rotation.T @ shown.rotation  # from the world to the rig
        centre = shown.centre + turn.T @ (mount.centre - base.centre)
        views.append(view.at(CameraPose(mount.rotation @ turn, centre)))
    return model.with_views(views)
