"""Camera poses from a COLMAP model, from files of Strecha or 7-Scenes, one for each photo, or from
the table of LLFF."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.colmap.model_files import (
    has_model,
    read_model,
)
from jaxsfm.errors import UserError
from jaxsfm.io.photo_folder import find_images


class CameraPose(NamedTuple):
    """The position and the direction of a camera."""

    rotation: np.ndarray
    """float64 (3, 3), world to camera."""
    centre: np.ndarray
    """float64 (3,), world units."""


Poses = dict[str, CameraPose]
_SUBFOLDERS = ("", "gt_dense_cameras", "sparse/0", "sparse")
LLFF = "poses_bounds.npy"
"""The file of LLFF and of many radiance fields: a row of 17 numbers for each photo, in the order of
the photos' names. The first 15 are a matrix 3 x 5: the axes of the camera (down, right, backwards)
in the world, its centre, and the photo's height, width and focal length."""


def model_poses(model: pycolmap.Reconstruction) -> Poses:
    """The poses of a model's registered images, by name."""
    poses = {}
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        rotation = image.cam_from_world().rotation.matrix()
        poses[image.name] = CameraPose(rotation, np.asarray(image.projection_center()))
    return poses


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that is nearest to a matrix: of a sum of rotations, their mean."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _read_strecha(path: Path) -> CameraPose:
    """Read a file with K (3 rows), a row of zeros, R camera-to-world (3 rows), centre, size."""
    try:
        values = [float(v) for v in path.read_text(encoding="utf-8").split()]
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: not a Strecha camera file ({error})") from error
    if len(values) < 24 or not np.isfinite(values).all():
        raise UserError(f"{path}: not a Strecha camera file (expected at least 24 finite numbers)")
    return _pose(path, np.asarray(values[12:21]).reshape(3, 3), np.asarray(values[21:24]))


def _pose(path: Path, camera_to_world: np.ndarray, centre: np.ndarray) -> CameraPose:
    """The pose of a file; UserError if its matrix (3, 3) is no rotation, up to rounding."""
    rotation = camera_to_world.T
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise UserError(f"{path}: its rotation is not a rotation matrix")
    return CameraPose(rotation, centre)


def _read_matrix(path: Path) -> CameraPose:
    """Read a file with a matrix 4 x 4, camera to world, as 7-Scenes has them."""
    try:
        values = [float(v) for v in path.read_text(encoding="utf-8").split()]
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: not a pose ({error})") from error
    if len(values) != 16 or not np.isfinite(values).all():
        raise UserError(f"{path}: not a pose (expected 4 x 4 finite numbers)")
    matrix = np.asarray(values).reshape(4, 4)
    return _pose(path, matrix[:3, :3], matrix[:3, 3])


def _photo_of(file: Path) -> str:
    """The name of a pose file's photo without its suffix. 7-Scenes calls the photos
    NAME.color.png."""
    stem = file.name.removesuffix(".pose.txt")
    return f"{stem}.color" if (file.parent / f"{stem}.color.png").is_file() else stem


def _read_llff(path: Path) -> Poses:
    """The poses of the photos in a folder, or in its sub-folder `images`."""
    photos = path.parent / "images" if (path.parent / "images").is_dir() else path.parent
    try:
        with path.open("rb") as file:
            rows = np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path}: not a table of poses ({error})") from error
    if rows.dtype.kind not in "fiu":
        raise UserError(f"{path}: not a table of poses (no numbers)")
    names = find_images(photos)
    if rows.shape != (len(names), 17) or not np.isfinite(rows[:, :15]).all():
        raise UserError(
            f"{path}: not the poses of the photos in {photos} (expected {len(names)} rows of 17 "
            f"finite numbers, got {' x '.join(map(str, rows.shape))})"
        )
    poses = {}
    for name, row in zip(names, rows.astype(np.float64), strict=True):
        down, right, back, centre, _ = row[:15].reshape(3, 5).T
        poses[name] = _pose(path, np.stack([right, down, -back], axis=1), centre)
    return poses


def read_poses(path: Path, *, option: str = "--reference") -> Poses:
    """Read reference poses, in the folder or below it: Strecha's `.camera` files, the `.pose.txt`
    files of 7-Scenes, LLFF's `poses_bounds.npy`, or a COLMAP model.

    Args:
      option: the option that names it, for messages.

    Raises:
      UserError: there is nothing of these kinds, or it is damaged.
    """
    if not path.is_dir():
        raise UserError(f"{option} {path}: no such folder")
    for sub in _SUBFOLDERS:
        folder = path / sub
        if cameras := sorted(folder.glob("*.camera")):
            return {file.name.removesuffix(".camera"): _read_strecha(file) for file in cameras}
        if matrices := sorted(folder.glob("*.pose.txt")):
            return {_photo_of(file): _read_matrix(file) for file in matrices}
        if has_model(folder):
            return model_poses(read_model(folder))
    if (path / LLFF).is_file():  # last: a model beside it has the photos' names
        return _read_llff(path / LLFF)
    raise UserError(
        f"{option} {path}: no .camera files, .pose.txt files, {LLFF} or COLMAP model in it"
    )
