"""Rigs: cameras that are mounted together, as COLMAP's `rig_config.json` describes them.

A *frame* is one instant: a photo of each camera at most, whose names are the same after the prefix
of the camera. One camera of a rig is the reference, whose axes are those of the rig.
"""

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.images import shown_name

LEAST_NORM = 0.99
"""A quaternion whose length differs from 1 by more than 1 % was not meant as a rotation: two
decimals of each number are rounded by less."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RigCamera:
    """A camera of a rig."""

    prefix: str
    """Names of its photos begin with it, and the rest names the frame."""
    rotation: np.ndarray | None = None
    """float64 (3, 3), from the axes of the rig to those of the camera; None: it is estimated."""
    translation: np.ndarray | None = None
    """float64 (3,): x_camera = rotation @ x_rig + translation, metres. None: it is estimated."""
    model: str | None = None
    """COLMAP's camera model; None: the camera is not known."""
    params: tuple[float, ...] = ()
    """Of the camera model, in COLMAP's pixels."""

    @property
    def known(self) -> bool:
        """Whether it is known where the camera is mounted."""
        return self.rotation is not None and self.translation is not None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """Cameras that are mounted together.

    ValueError if the poses of the cameras are not what `read_rigs` would read.
    """

    cameras: tuple[RigCamera, ...]
    reference: int
    """Index of the camera whose axes are those of the rig. Its rotation is the identity, and its
    translation is zero."""

    def __post_init__(self) -> None:
        if not 0 <= self.reference < len(self.cameras):
            raise ValueError(f"reference must be one of {len(self.cameras)}; got {self.reference}")
        for number, each in enumerate(self.cameras):
            if (each.rotation is None) != (each.translation is None):
                raise ValueError(f"{each.prefix}: rotation and translation must be given together")
            if number == self.reference and not _is_identity(each):
                raise ValueError(f"{each.prefix}: the reference must have the pose of the rig")

    def plain(self) -> Json:
        """The same as JSON, which tells different rigs apart."""
        cameras: list[Json] = [
            [
                each.prefix,
                None if each.rotation is None else each.rotation.tolist(),
                None if each.translation is None else each.translation.tolist(),
                each.model,
                list(each.params),
            ]
            for each in self.cameras
        ]
        return [self.reference, cameras]


def _is_identity(camera: RigCamera) -> bool:
    same = camera.rotation is not None and np.array_equal(camera.rotation, np.eye(3))
    return same and camera.translation is not None and not camera.translation.any()


class _CameraEntry(msgspec.Struct, forbid_unknown_fields=True):
    """A camera in COLMAP's file."""

    image_prefix: str
    ref_sensor: bool = False
    cam_from_rig_rotation: tuple[float, float, float, float] | None = None
    cam_from_rig_translation: tuple[float, float, float] | None = None
    camera_model_name: str | None = None
    camera_params: tuple[float, ...] | None = None


class _RigEntry(msgspec.Struct, forbid_unknown_fields=True):
    cameras: list[_CameraEntry]


def read_rigs(path: Path) -> tuple[Rig, ...]:
    """Read COLMAP's `rig_config.json`.

    Raises:
      UserError: it is no such file, or its rigs cannot be (`check_prefixes`).
    """
    where = f"--rig {path}"
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{where}: cannot be read as text") from error
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where}: is not JSON ({error})") from error
    try:
        entries = msgspec.convert(content, list[_RigEntry])
    except msgspec.ValidationError as error:
        raise UserError(f"{where}: is not a rig_config.json of COLMAP ({error})") from error
    rigs = tuple(_rig(f"{where}: rig {k}", entry) for k, entry in enumerate(entries, 1))
    check_prefixes(rigs, where)
    return rigs


def _rig(where: str, entry: _RigEntry) -> Rig:
    references = [k for k, camera in enumerate(entry.cameras) if camera.ref_sensor]
    if len(references) != 1:
        raise UserError(
            f'{where}: one camera must be the reference ("ref_sensor": true); {len(references)} are'
        )
    return Rig(
        cameras=tuple(_camera(where, each) for each in entry.cameras), reference=references[0]
    )


def _camera(where: str, entry: _CameraEntry) -> RigCamera:
    where = f"{where}, {shown_name(entry.image_prefix)}"
    turned, moved = entry.cam_from_rig_rotation, entry.cam_from_rig_translation
    if (turned is None) != (moved is None):
        raise UserError(
            f"{where}: cam_from_rig_rotation and cam_from_rig_translation must be given together"
        )
    if (entry.camera_model_name is None) != (entry.camera_params is None):
        raise UserError(f"{where}: camera_model_name and camera_params must be given together")
    numbers = np.asarray([*(turned or ()), *(moved or ()), *(entry.camera_params or ())])
    if not np.isfinite(numbers).all():
        raise UserError(f"{where}: the numbers must be finite")
    rotation = translation = None
    if entry.ref_sensor:
        rotation, translation = np.eye(3), np.zeros(3)
    if turned is not None and moved is not None:
        if entry.ref_sensor:
            raise UserError(f"{where}: the reference has no cam_from_rig pose, as it is the rig's")
        rotation, translation = _rotation(where, turned), np.asarray(moved)
    return RigCamera(
        prefix=entry.image_prefix,
        rotation=rotation,
        translation=translation,
        model=entry.camera_model_name,
        params=tuple(entry.camera_params or ()),
    )


def _rotation(where: str, quaternion: tuple[float, float, float, float]) -> np.ndarray:
    """float64 (3, 3): the rotation of a quaternion (w, x, y, z)."""
    norm = float(np.linalg.norm(quaternion))
    if not LEAST_NORM <= norm <= 1 / LEAST_NORM:
        raise UserError(
            f"{where}: cam_from_rig_rotation must be a quaternion w, x, y, z of length 1; "
            f"its length is {norm:.3g}"
        )
    w, *xyz = np.asarray(quaternion) / norm
    x, y, z = xyz
    cross = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross)


def check_prefixes(rigs: Iterable[Rig], where: str) -> None:
    """Raise UserError if a photo could belong to two cameras of the rigs.

    Args:
      where: the beginning of the sentence.
    """
    prefixes = sorted(camera.prefix for rig in rigs for camera in rig.cameras)
    for one, other in zip(prefixes, prefixes[1:], strict=False):
        if one == other:
            raise UserError(f"{where}: {shown_name(one)} is the prefix of two cameras")
        if other.startswith(one):  # sorted, so a prefix comes right before what it begins
            raise UserError(
                f"{where}: the prefix {shown_name(other)} begins with that of another camera, "
                f"{shown_name(one)}; end prefixes with /"
            )


class RigPhoto(NamedTuple):
    """What a photo of a rig is."""

    rig: int
    camera: int
    """Index in `Rig.cameras`."""
    frame: str
    """Its name after the prefix: the photos of one rig with the same one were taken together."""


def rig_photos(rigs: Iterable[Rig], names: Iterable[str]) -> dict[str, RigPhoto]:
    """The photos that cameras of rigs have taken, by name, in the order of names."""
    cameras = [
        (each.prefix, r, c) for r, rig in enumerate(rigs) for c, each in enumerate(rig.cameras)
    ]
    return {
        name: RigPhoto(rig, camera, name.removeprefix(prefix))
        for name in sorted(names)
        for prefix, rig, camera in cameras
        if name.startswith(prefix)
    }


def check_rigs(rigs: Sequence[Rig], sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raise UserError if a camera of a rig has no photos, or photos of different sizes.

    Args:
      sizes: (width, height) of all photos, by name.
    """
    taken: dict[tuple[int, int], list[str]] = {}
    for name, photo in rig_photos(rigs, sizes).items():
        taken.setdefault((photo.rig, photo.camera), []).append(name)
    for r, rig in enumerate(rigs):
        for c, camera in enumerate(rig.cameras):
            prefix, names = shown_name(camera.prefix), taken.get((r, c), [])
            if not names:
                raise UserError(f"--rig: no photo has a name that begins with {prefix}")
            first = sizes[names[0]]
            for name in names:
                if sizes[name] != first:
                    raise UserError(
                        f"--rig: the photos of the camera {prefix} differ in size: "
                        f"{shown_name(names[0])} has {first[0]} x {first[1]} pixels, and "
                        f"{shown_name(name)} has {sizes[name][0]} x {sizes[name][1]}"
                    )


def incomplete_frames(rigs: Sequence[Rig], names: Iterable[str]) -> list[str]:
    """The first photo of each frame that has not a photo of each camera of its rig."""
    frames = frames_of(rig_photos(rigs, names))
    return [own[0] for (rig, _), own in frames.items() if len(own) < len(rigs[rig].cameras)]


def frames_of(photos: Mapping[str, RigPhoto]) -> dict[tuple[int, str], list[str]]:
    """The names of the photos of each frame, by the rig and the name of the frame."""
    frames: dict[tuple[int, str], list[str]] = {}
    for name, photo in photos.items():
        frames.setdefault((photo.rig, photo.frame), []).append(name)
    return frames
