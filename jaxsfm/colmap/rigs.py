"""Rigs of several cameras in COLMAP's databases and models.

COLMAP calls a camera of a rig a sensor, by the id of the camera. So each one has a camera of its
own. All photos of a frame have a pose as soon as the frame has one.
"""

import copy
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.colmap.database import camera_sensor, changed, opened, read_images
from jaxsfm.colmap.two_views import TwoView
from jaxsfm.colmap.view import View
from jaxsfm.io.pairs import Pair


class Rigs(NamedTuple):
    """The rigs of several cameras, and the photos that belong to their frames."""

    rigs: Mapping[int, pycolmap.Rig]
    """By id. In a database, the pose of a camera is None if it is to be estimated."""
    frames: Mapping[int, tuple[int, int]]
    """Image id -> the ids of its frame and of its rig. Other images are frames of their own."""

    @classmethod
    def of(cls, rigs: Iterable[pycolmap.Rig], frames: Iterable[pycolmap.Frame]) -> "Rigs | None":
        """Those of a database or a model; None if there is no rig of several cameras.

        They are numbered anew, so that their ids are not those that COLMAP gives to the rigs and
        frames of single photos: a rig has the id of its reference camera, and a frame that of its
        first photo.
        """
        found, ids = dict[int, pycolmap.Rig](), dict[int, int]()
        for rig in rigs:
            sensors = sorted(rig.sensor_ids(), key=lambda sensor: sensor.id)
            if len(sensors) > 1 and {s.type for s in sensors} == {pycolmap.SensorType.CAMERA}:
                own = pycolmap.Rig(rig_id=rig.ref_sensor_id.id)
                own.add_ref_sensor(rig.ref_sensor_id)
                for sensor in sensors:
                    if not rig.is_ref_sensor(sensor):
                        own.add_sensor(sensor, rig.sensor_from_rig(sensor))
                found[own.rig_id], ids[rig.rig_id] = own, own.rig_id
        of_image = dict[int, tuple[int, int]]()
        for frame in frames if found else ():
            images = [data.id for data in frame.image_ids] if frame.rig_id in ids else []
            of_image |= {image: (min(images), ids[frame.rig_id]) for image in images}
        return cls(found, of_image) if found else None

    def cameras(self) -> set[int]:
        """The ids of the cameras that are mounted on rigs."""
        return {sensor.id for rig in self.rigs.values() for sensor in rig.sensor_ids()}

    def is_placed(self, image_id: int) -> bool:
        """Whether the place of a photo follows from that of its frame, or is its own."""
        _, rig_id = self.frames.get(image_id, (0, 0))
        rig = self.rigs.get(rig_id)
        poses = [self.cam_from_rig(s.id, rig_id) for s in rig.sensor_ids()] if rig else []
        return all(pose is not None for pose in poses)

    def cam_from_rig(self, camera_id: int, rig_id: int) -> pycolmap.Rigid3d | None:
        """Where a camera is mounted; None if it is not known."""
        rig, sensor = self.rigs[rig_id], camera_sensor(camera_id)
        return pycolmap.Rigid3d() if rig.is_ref_sensor(sensor) else rig.sensor_from_rig(sensor)

    def add_to(
        self, model: pycolmap.Reconstruction, views: Sequence[View], counts: Sequence[int]
    ) -> None:
        """Add the rigs to a model that has their cameras, and the frames of these views.

        A frame stands where its view with most observations says.

        Args:
          counts: the number of observations of each view.
        """
        for _, rig in sorted(self.rigs.items()):
            model.add_rig(copy.deepcopy(rig))
        members: dict[tuple[int, int], list[tuple[int, View]]] = {}
        for view, count in zip(views, counts, strict=True):
            if view.image_id in self.frames:
                members.setdefault(self.frames[view.image_id], []).append((count, view))
        for (frame_id, rig_id), own in sorted(members.items()):
            best = max(own, key=lambda each: each[0])[1]
            mount = self.cam_from_rig(best.camera.camera_id, rig_id)
            assert mount is not None
            frame = pycolmap.Frame(
                frame_id=frame_id,
                rig_id=rig_id,
                rig_from_world=mount.inverse() * best.cam_from_world(),
            )
            for _, view in own:
                sensor = camera_sensor(view.camera.camera_id)
                frame.add_data_id(pycolmap.data_t(sensor, view.image_id))
            model.add_frame(frame)


def rigs_of_model(model: pycolmap.Reconstruction) -> Rigs | None:
    """The rigs of several cameras in a model; None if it has none."""
    return Rigs.of(model.rigs.values(), model.frames.values())


def rigs_of_database(path: Path) -> Rigs | None:
    """The rigs of several cameras in a database; None if it has none."""
    with opened(path) as db:
        return Rigs.of(db.read_all_rigs(), db.read_all_frames())


def clear_rigs(path: Path) -> None:
    """Take all rigs and frames out of a database, so that each photo stands alone."""
    with changed(path) as db:
        db.clear_frames()
        db.clear_rigs()


def have_common_centre(rigs: Rigs) -> bool:
    """Whether all cameras of all rigs are known to have one centre, as views of panoramas do."""
    poses = [rigs.cam_from_rig(s.id, k) for k, r in rigs.rigs.items() for s in r.sensor_ids()]
    return all(pose is not None and not np.any(pose.translation) for pose in poses)


def gives_scale(model: pycolmap.Reconstruction, held: Iterable[int]) -> bool:
    """Whether a camera that is held on its rig stands away from the centre of the rig.

    Args:
      held: ids of cameras whose place on their rig is known.
    """
    rigs, fixed = rigs_of_model(model), set(held)
    if rigs is None:
        return False
    return any(
        np.any(pose.translation)
        for k, rig in rigs.rigs.items()
        for sensor in rig.sensor_ids()
        if sensor.id in fixed and (pose := rigs.cam_from_rig(sensor.id, k)) is not None
    )


def whole_frames(parts: Iterable[Sequence[str]], model: pycolmap.Reconstruction) -> list[list[str]]:
    """Parts of a model, where parts that have photos of one frame are one: their rig joins them.

    Returns:
      names of photos, the largest part first; the given parts if the model has no rigs.
    """
    rigs = rigs_of_model(model)
    found = [list(part) for part in parts]
    if rigs is None:
        return found
    frame = {model.image(i).name: of[0] for i, of in rigs.frames.items()}
    joined: list[tuple[set[int], list[str]]] = []
    for part in found:
        own = {frame[name] for name in part if name in frame}
        apart = [each for each in joined if not each[0] & own]
        for each in joined:
            if each[0] & own:
                own, part = own | each[0], each[1] + part
        joined = [*apart, (own, part)]
    return sorted((part for _, part in joined), key=lambda part: (-len(part), part))


def mounted_photos(model: pycolmap.Reconstruction) -> set[str]:
    """The names of photos whose frame has further photos, which say where they stand."""
    rigs = rigs_of_model(model)
    if rigs is None:
        return set()
    members = Counter(rigs.frames.values())
    return {model.image(i).name for i, frame in rigs.frames.items() if members[frame] > 1}


def pairs_against_rigs(
    path: Path, views: Mapping[Pair, TwoView], rotation_deg: float
) -> list[Pair]:
    """The verified pairs within a frame that say something else of it than its rig.

    These are pairs of cameras that have one centre, because nothing moved between two photos of one
    instant, and pairs that are turned otherwise than the rig by more than `rotation_deg`.

    Args:
      path: the database of the pairs.
    """
    rigs = rigs_of_database(path)
    if rigs is None:
        return []
    images, found = read_images(path), list[Pair]()
    for pair, view in sorted(views.items()):
        (a, camera), (b, other) = (images[name] for name in pair)
        frame = rigs.frames.get(a)
        if frame is None or frame != rigs.frames.get(b):
            continue
        mounts = [rigs.cam_from_rig(each.camera_id, frame[1]) for each in (camera, other)]
        if mounts[0] is None or mounts[1] is None:
            continue
        known, told = mounts[1] * mounts[0].inverse(), view.geometry.rotation
        turned = 0.0
        if told is not None:
            turned = np.degrees((pycolmap.Rotation3d(told) * known.rotation.inverse()).angle())
        if not np.any(known.translation) or turned > rotation_deg:
            found.append(pair)
    return found


def one_of_each_frame(names: Iterable[str], model: pycolmap.Reconstruction) -> list[str]:
    """The first photo of each frame among photos of a model, in their order."""
    rigs = rigs_of_model(model)
    if rigs is None:
        return list(names)
    frames = {x.name: rigs.frames.get(number, (number, -1)) for number, x in model.images.items()}
    first: dict[tuple[int, int], str] = {}
    for name in names:
        first.setdefault(frames[name], name)
    return list(first.values())
