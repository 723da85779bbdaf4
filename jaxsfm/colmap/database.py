"""COLMAP's database (pycolmap 4.2).

Everything is checked before COLMAP sees it, because a match index out of range ends the process in
native code, and some unset options fail silently.
"""

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import SPARE_BYTES, check_disk_space
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairResult, describe
from jaxsfm.io.rig_config import Rig, frames_of, rig_photos

PIXEL_OFFSET = np.float32(0.5)
"""COLMAP puts the centre of the top-left pixel at (0.5, 0.5)."""


def keypoint_tables(results: Iterable[PairResult]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The keypoints of every image: those of the cells that any pair uses.

    A cell is the same keypoint in every pair. So tracks can be joined by its index.

    Returns:
      by image name: int (n,) cells, ascending; float32 (n, 2), their (x, y) in original pixels.
    """
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for result in results:
        for side, xy in enumerate((result.keypoints0, result.keypoints1)):
            rows = parts.setdefault(result.pair[side], [])
            rows.append((result.cells[:, side], xy))
            if len(rows) > UNITED:  # a cell comes back in most pairs
                rows[:] = [_united(rows)]
    return {name: _united(rows) for name, rows in parts.items()}


UNITED = 16
"""After so many pairs of an image, their keypoints are united. Held apart, the keypoints of all
pairs would take gigabytes for 500 images."""


def _united(rows: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Unite cells and their (x, y): every cell once, ascending, with the first (x, y) it has."""
    cells, xy = (np.concatenate(column) for column in zip(*rows, strict=True))
    cells, first = np.unique(cells, return_index=True)
    return cells, xy[first]


def _consistent(results: Mapping[Pair, PairResult]) -> Iterator[PairResult]:
    """The results, one by one; ValueError for one on which COLMAP would end the process."""
    for pair, result in results.items():
        if pair != result.pair:
            raise ValueError(f"pair {describe(pair)} holds the result of {describe(result.pair)}")
        n = result.num_inliers
        if not (result.cells.shape == result.keypoints0.shape == result.keypoints1.shape == (n, 2)):
            raise ValueError(f"pair {describe(pair)}: cells and keypoints must be {n} x 2")
        if any(len(np.unique(column)) != n for column in result.cells.T):
            raise ValueError(f"pair {describe(pair)}: a keypoint is matched twice")
        yield result


def write_database(
    path: Path,
    images: list[ImageFile],
    results: Mapping[Pair, PairResult],
    cameras: Cameras,
) -> None:
    """Write a new COLMAP database with cameras, images, keypoints and matches.

    Args:
      path: a file there is replaced.
      images: all images. Those without matches get no keypoints.
      results: the matches. Each is read twice, and none is held in memory.
      cameras: which images share a camera, and what is known of it.

    Raises:
      ValueError: the results are inconsistent. Nothing is written then.
      UserError: the disk is full, or COLMAP does not accept a camera.
    """
    matched = 0

    def counted() -> Iterator[PairResult]:
        nonlocal matched
        for result in _consistent(results):
            matched += result.num_inliers
            yield result

    tables = keypoint_tables(counted())
    names = {image.name: image for image in images}
    if unknown := sorted(tables.keys() - names.keys()):
        raise ValueError(f"results name images that are not given: {unknown[0]!r}")
    for name, (_, xy) in tables.items():
        if not np.isfinite(xy).all():
            raise ValueError(f"{name}: keypoints must be finite")
        if (xy < -0.5).any() or (xy > np.asarray(names[name].size) - 0.5).any():
            raise ValueError(f"{name}: keypoints outside the image {names[name].size}")
    rows = sum(len(xy) for _, xy in tables.values()) + 2 * matched
    check_disk_space(path.parent, SPARE_BYTES + 2 * 8 * rows)  # twice, because of SQLite's journal

    def pairs() -> Iterator[tuple[Pair, np.ndarray]]:
        for a, b in sorted(results):
            cells = results[a, b].cells
            if len(cells):
                columns = zip((a, b), cells.T, strict=True)
                index = [np.searchsorted(tables[name][0], column) for name, column in columns]
                yield (a, b), np.stack(index, axis=1)

    keypoints = {name: xy for name, (_, xy) in tables.items()}
    _write(path, images, keypoints, pairs(), cameras)


class KeypointMatches(NamedTuple):
    """Keypoints of photos and matches between them."""

    keypoints: Mapping[str, np.ndarray]
    """float (n, 2) for each photo, pixels; the centre of the top-left pixel is (0, 0)."""
    matches: Mapping[Pair, np.ndarray]
    """int (m, 2) for each pair: which keypoint of the first photo, and which of the second."""


def write_keypoint_matches(
    path: Path, images: list[ImageFile], found: KeypointMatches, cameras: Cameras
) -> None:
    """Write a new COLMAP database of keypoints that are not ours. Arguments are those of
    `write_database`."""
    rows = ((pair, index) for pair, index in sorted(found.matches.items()) if len(index))
    _write(path, images, found.keypoints, rows, cameras)


class CannotOpen(UserError):
    """COLMAP cannot open a database."""


@contextlib.contextmanager
def opened(path: Path) -> Iterator[pycolmap.Database]:
    """Open a database, which COLMAP makes if it is missing, and writes into even to read it.

    Raises CannotOpen.
    """
    try:
        database = pycolmap.Database.open(path)
    except RuntimeError as error:
        raise CannotOpen(
            f"{path}: COLMAP cannot open this database; it needs space on the disk and the "
            "permission to write, even to read it"
        ) from error
    with database:
        yield database


@contextlib.contextmanager
def changed(path: Path) -> Iterator[pycolmap.Database]:
    """Open a database for changes, which are made together when the block ends.

    Raises CannotOpen, or UserError if SQLite's journal, which holds what is changed as
    it was, does not fit on the disk: then COLMAP would end the process.
    """
    size = path.stat().st_size if path.exists() else 0
    check_disk_space(path.parent, SPARE_BYTES + size)
    with opened(path) as db, pycolmap.DatabaseTransaction(db):
        yield db


def _write(
    path: Path,
    images: list[ImageFile],
    keypoints: Mapping[str, np.ndarray],
    matches: Iterable[tuple[Pair, np.ndarray]],
    cameras: Cameras,
) -> None:
    empty = np.zeros((0, 2), np.float32)
    path.unlink(missing_ok=True)
    with changed(path) as db:
        camera_ids, ids = {}, {}
        for camera, group in cameras.assigned(images):
            camera_ids |= dict.fromkeys((i.name for i in group), db.write_camera(camera))
        for image in sorted(images, key=lambda i: i.name):
            ids[image.name] = db.write_image(
                pycolmap.Image(name=image.name, camera_id=camera_ids[image.name])
            )
            xy = keypoints.get(image.name, empty)
            db.write_keypoints(ids[image.name], (xy + PIXEL_OFFSET).astype(np.float32))
        _write_rigs(db, cameras.rigs, ids, camera_ids)
        for (a, b), index in matches:
            db.write_matches(ids[a], ids[b], index.astype(np.uint32))


def _write_rigs(
    db: pycolmap.Database,
    rigs: Sequence[Rig],
    ids: Mapping[str, int],
    camera_ids: Mapping[str, int],
) -> None:
    """Write rigs and frames; without rigs, COLMAP makes a frame of each photo by itself.

    A rig has the number of its reference camera, and a frame that of its first photo.
    """
    photos = rig_photos(rigs, ids)
    number = {photo[:2]: camera_ids[name] for name, photo in photos.items()}

    def write(rig_id: int, names: Sequence[str]) -> None:
        frame = pycolmap.Frame(frame_id=min(ids[name] for name in names), rig_id=rig_id)
        for name in names:
            frame.add_data_id(pycolmap.data_t(camera_sensor(camera_ids[name]), ids[name]))
        db.write_frame(frame, use_frame_id=True)

    for r, rig in enumerate(rigs):
        made = pycolmap.Rig(rig_id=number[r, rig.reference])
        made.add_ref_sensor(camera_sensor(made.rig_id))
        for c, camera in enumerate(rig.cameras):
            if c != rig.reference:
                pose = None
                if camera.rotation is not None and camera.translation is not None:
                    turn = pycolmap.Rotation3d(np.ascontiguousarray(camera.rotation))
                    pose = pycolmap.Rigid3d(turn, camera.translation)
                made.add_sensor(camera_sensor(number[r, c]), pose)
        db.write_rig(made, use_rig_id=True)
    for (r, _), names in frames_of(photos).items():
        write(number[r, rigs[r].reference], names)
    alone = sorted(ids.keys() - photos.keys()) if rigs else []
    for camera_id in sorted({camera_ids[name] for name in alone}):
        made = pycolmap.Rig(rig_id=camera_id)
        made.add_ref_sensor(camera_sensor(camera_id))
        db.write_rig(made, use_rig_id=True)
    for name in alone:
        write(camera_ids[name], [name])


def camera_sensor(camera_id: int) -> pycolmap.sensor_t:
    """A camera as COLMAP names it in rigs."""
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def image_ids(db: pycolmap.Database) -> dict[str, int]:
    """The numbers of the images, by name."""
    return {image.name: image.image_id for image in db.read_all_images()}


def read_matches(
    path: Path, names: tuple[str, str], *, verified: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Read the matches of a pair from a database.

    Args:
      names: of the two images.
      verified: read the two-view inliers; otherwise the matches before verification.

    Returns:
      float64 (n, 2) for each image, in the order of `names`: original pixels, where the centre of
      the top-left one is (0, 0).
    """
    with opened(path) as db:
        ids = image_ids(db)
        a, b = ids[names[0]], ids[names[1]]
        if not verified:
            matches = db.read_matches(a, b)
        elif db.exists_two_view_geometry(a, b):
            matches = db.read_two_view_geometry(a, b).inlier_matches
        else:
            matches = []
        rows = np.asarray(matches).reshape(-1, 2).astype(np.int64)
        xy = [colmap_xy(db, i).astype(np.float64) - PIXEL_OFFSET for i in (a, b)]
    return xy[0][rows[:, 0]], xy[1][rows[:, 1]]


def colmap_xy(db: pycolmap.Database, image_id: int) -> np.ndarray:
    """Where the keypoints of an image lie, float32 (n, 2), in COLMAP's pixels (`PIXEL_OFFSET`).

    COLMAP's own keypoints have a shape behind their place: four or six numbers in all.
    """
    return np.asarray(db.read_keypoints(image_id), np.float32)[:, :2].reshape(-1, 2)


def read_images(path: Path) -> dict[str, tuple[int, pycolmap.Camera]]:
    """Read the id and the camera of every image in a database, by name."""
    with opened(path) as db:
        cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}
        return {i.name: (i.image_id, cameras[i.camera_id]) for i in db.read_all_images()}


def drop_pairs(path: Path, pairs: Iterable[Pair]) -> None:
    """Delete the verified geometries of pairs from a database. Their matches stay."""
    with changed(path) as db:
        ids = image_ids(db)
        for a, b in pairs:
            db.delete_two_view_geometry(ids[a], ids[b])
