"""COLMAP's model files: found, checked, read and written.

The check is for what COLMAP's own readers do not notice. They trust every count of a binary file
and do not look at the file's end. So a file that was cut off is read as if it were whole, or fills
the memory, or is read for ever. COLMAP reads numbers that are not finite, and rotations of length
zero, too. In a text file, it ends a name at a blank. Wrong ids and indices, and camera models that
do not exist, are COLMAP's to refuse.
`tests/colmap/test_model_files.py` shows what COLMAP does with each kind of damage.

Layout: COLMAP 4, src/colmap/scene/reconstruction_io.cc; all little-endian.
"""

import shutil
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.database import opened
from jaxsfm.colmap.formats.tables import (
    camera_fault,
    clash,
    clash_fault,
    name_fault,
    num_camera_params,
)
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import SPARE_BYTES, check_disk_space
from jaxsfm.io.images import shown_name

ABSURD = 1e100
"""Larger numbers are refused. Squares of smaller ones are finite."""
_MODELS = ("", "sparse/0", "sparse", "colmap/sparse/0", "sfm")
"""Where models lie in a folder: COLMAP's and ours, nerfstudio's, hloc's."""
_FILES = ("cameras", "images", "points3D")


class DamagedModelError(ValueError):
    """A model file is damaged. The message says what is wrong, and in which file."""


def has_model(path: Path) -> bool:
    """Whether a COLMAP model (binary or text) is in this folder itself."""
    return (path / "images.bin").is_file() or (path / "images.txt").is_file()


def find_model(path: Path) -> Path:
    """The model's folder: this one, or one in the results of a run, of nerfstudio or of hloc.

    Raises:
      UserError: there is none.
    """
    for sub in _MODELS:
        if has_model(path / sub):
            return path / sub
    raise UserError(f"{path}: no COLMAP model here (looked for sparse/0/images.bin)")


def read_model(path: Path) -> pycolmap.Reconstruction:
    """Read the COLMAP model (binary or text) in a folder.

    Raises:
      UserError: there is none, or it is damaged.
    """
    suffix = ".bin" if (path / "images.bin").is_file() else ".txt"
    if path.is_dir():
        for name in _FILES:
            if not (path / (name + suffix)).is_file():
                raise UserError(f"{path}: not a readable COLMAP model ({name}{suffix} is missing)")
    try:
        if suffix == ".bin":
            check_binary(path)
        model = pycolmap.Reconstruction(path)
        if suffix == ".txt":
            check_text(path, model)
        _check_names([image.name for image in model.images.values()], suffix)
        if not model.is_valid():
            raise DamagedModelError("its files do not fit together")
        return model
    except DamagedModelError as error:
        raise UserError(f"{path}: not a readable COLMAP model ({error})") from error
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}: not a readable COLMAP model (images{suffix}: a name that is not UTF-8)"
        ) from error
    except Exception as error:  # native errors of several kinds, whose texts are long
        raise UserError(f"{path}: not a readable COLMAP model") from error


def _check_names(names: list[str], suffix: str) -> None:
    """Raise DamagedModelError if names cannot be those of photos in one folder."""
    fault = next((fault for fault in map(name_fault, names) if fault), None)
    if fault is None and (both := clash(names)):
        fault = clash_fault(both)
    if fault is not None:
        raise DamagedModelError(f"images{suffix}: {fault}")


def read_models(folder: Path, database: Path) -> list[pycolmap.Reconstruction]:
    """Read what `write_models` wrote. Files are checked before COLMAP reads them.

    Args:
      database: of the same cameras. It says which focal lengths were known before mapping, which
        COLMAP's model files do not.

    Raises:
      UserError: a model is damaged, or has a camera that the database has not.
    """
    with opened(database) as db:
        known = {c.camera_id: c.has_prior_focal_length for c in db.read_all_cameras()}
    models = []
    while (path := folder / str(len(models))).is_dir():
        model = read_model(path)
        for camera_id, camera in model.cameras.items():
            if camera_id not in known:
                raise UserError(f"{path}: its camera {camera_id} is not in {database.name}")
            camera.has_prior_focal_length = known[camera_id]
        models.append(model)
    return models


def write_models(models: list[pycolmap.Reconstruction], folder: Path) -> None:
    """Write models into `folder`/0 (the best one), 1, 2, ... The folder is replaced."""
    shutil.rmtree(folder, ignore_errors=True)
    for index, model in enumerate(models):
        target = folder / str(index)
        target.mkdir(parents=True)
        write_model(model, target)


def model_bytes(model: pycolmap.Reconstruction) -> int:
    """About how many bytes the binary files of a model have, with some to spare."""
    points2d = sum(image.num_points2D() for image in model.images.values())
    rows = 24 * points2d + 8 * model.compute_num_observations() + 51 * model.num_points3D()
    return SPARE_BYTES + rows


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write the binary files of a model into an existing folder.

    COLMAP writes files that are cut off and says nothing if the disk becomes full, so they are
    looked at again. Raises UserError if they do not fit on the disk.
    """
    check_disk_space(folder, model_bytes(model))
    model.write_binary(folder)
    try:
        check_binary(folder)
    except (DamagedModelError, OSError) as error:
        raise UserError(f"{folder}: cannot be written (the model was cut off: {error})") from error


class _Reader:
    """Reads the values of a file one after the other.

    Args:
      name: what messages call the file.
    """

    def __init__(self, path: Path, name: str) -> None:
        self.name, self.data, self.at = name, path.read_bytes(), 0

    def bad(self, what: str) -> DamagedModelError:
        return DamagedModelError(f"{self.name}: {what}")

    def skip(self, size: int) -> int:
        """Skip a block of bytes, and return where it begins."""
        start, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise self.bad("it ends too early")
        return start

    def values(self, layout: str) -> tuple:
        """Read values by their letters in `struct`."""
        found = struct.unpack_from(
            "<" + layout, self.data, self.skip(struct.calcsize("<" + layout))
        )
        if not all(abs(v) < ABSURD for v in found if isinstance(v, float)):
            raise self.bad("a number in it is absurd")
        return found

    def skip_name(self) -> None:
        """Skip a text that ends with a zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.bad("a name without an end")
        self.at = end + 1

    def check_pose(self) -> None:
        """Skip a quaternion and a translation."""
        if not np.linalg.norm(self.values("7d")[:4]) > 1e-6:
            raise self.bad("a rotation of length zero")


def check_binary(folder: Path, suffix: str = ".bin") -> None:
    """Check the numbers of a binary model, and that each file ends where its counts say.

    Args:
      suffix: how the names of the files end in messages.

    Raises:
      DamagedModelError: a file is damaged.
      OSError: a file is missing.
    """
    entries: dict[str, Callable[[_Reader], None]] = {
        "cameras": _check_camera,
        "rigs": _check_rig,
        "images": _check_image,
        "frames": _check_frame,
        "points3D": _check_point,
    }
    for name, check in entries.items():
        path = folder / f"{name}.bin"
        if name in ("rigs", "frames") and not path.exists():  # COLMAP 3
            continue
        file = _Reader(path, name + suffix)
        (count,) = file.values("Q")
        for _ in range(count):  # each entry takes bytes, so that an absurd count ends the file
            check(file)
        if file.at != len(file.data):
            raise file.bad("it goes on after its last entry")


def check_text(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Check the names and the numbers of a text model, of which COLMAP has read `model`.

    Raises DamagedModelError if a file is damaged.
    """
    text = (folder / "images.txt").read_text(encoding="utf-8", errors="replace")
    lines = iter(text.split("\n"))
    for line in map(str.strip, lines):
        if not line or line.startswith("#"):
            continue
        words = line.split(maxsplit=9)
        if len(words) == 10 and " " in words[9]:
            raise DamagedModelError(
                f"images.txt: the name {shown_name(words[9])!r} has a blank in it, where COLMAP's "
                "text format ends a name; write the model as a binary one"
            )
        next(lines, None)  # the keypoints of the image
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        model.write_binary(scratch)
        check_binary(Path(scratch), ".txt")


def _check_camera(file: _Reader) -> None:
    camera, model, width, height = file.values("IiQQ")
    count = num_camera_params(model)
    params = file.values(f"{count}d") if count is not None else ()
    if fault := camera_fault(model, (width, height), params):
        raise file.bad(f"camera {camera}: {fault}")


def _check_rig(file: _Reader) -> None:
    _rig, sensors = file.values("II")
    for k in range(sensors):
        file.values("iI")
        if k and file.values("B")[0]:  # the first sensor is the origin of the rig
            file.check_pose()


def _check_image(file: _Reader) -> None:
    file.values("I")
    file.check_pose()
    file.values("I")
    file.skip_name()
    (keypoints,) = file.values("Q")
    start = file.skip(24 * keypoints)
    rows = np.frombuffer(file.data, "<f8", 3 * keypoints, start).reshape(keypoints, 3)
    if not (np.abs(rows[:, :2]) < ABSURD).all():  # the third column is the id of a point
        raise file.bad("a number in it is absurd")


def _check_frame(file: _Reader) -> None:
    file.values("II")
    file.check_pose()
    (images,) = file.values("I")
    file.skip(16 * images)


def _check_point(file: _Reader) -> None:
    file.values("Q3d")
    file.skip(3 + 8)  # the error is not read: that of a point behind a camera is 1e154
    (observations,) = file.values("Q")
    file.skip(8 * observations)
