"""Images and matches that are added to a COLMAP database. What is in it keeps its ids."""

import contextlib
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.database import PIXEL_OFFSET, CannotOpen, changed, opened, read_images
from jaxsfm.colmap.two_views import VerificationOptions, read_two_views, verify
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import SPARE_BYTES, check_disk_space
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairResult


def add_images(
    path: Path, images: Mapping[str, tuple[ImageFile, pycolmap.Camera]]
) -> dict[str, tuple[int, pycolmap.Camera]]:
    """Add images and their cameras to a database.

    Args:
      images: by name. A camera whose id is in the database is taken from there; others are added.

    Returns:
      id and camera of each image, by name.
    """
    with changed(path) as db:
        known = {camera.camera_id for camera in db.read_all_cameras()}
        for name, (_, camera) in sorted(images.items()):
            camera_id = camera.camera_id
            if camera_id not in known:
                camera_id = db.write_camera(camera)
            db.write_image(pycolmap.Image(name=name, camera_id=camera_id))
    every = read_images(path)
    return {name: every[name] for name in images}


@contextlib.contextmanager
def used_by_colmap(path: Path) -> Iterator[None]:
    """Report what COLMAP says of a database that it cannot use as a UserError that names `path`."""
    try:
        yield
    except RuntimeError as error:  # of SQLite in COLMAP, such as a constraint that failed
        raise UserError(f"{path}: COLMAP cannot use this database ({error})") from error
    except CannotOpen as error:  # of a copy, which the user does not know
        why = "it is damaged, or the disk has no space for a copy"
        raise UserError(f"{path}: COLMAP cannot open this database; {why}") from error


def copy_database(source: Path, target: Path, matches: int) -> None:
    """Copy a database to which `matches` matches will be added.

    Args:
      source: `check_database` has checked it.

    Raises:
      UserError: the copy, the copy that `add_matches` makes, and SQLite's journal do not fit on the
        disk.
    """
    # A match takes at most a keypoint in both images, itself and its verification: 8 bytes each.
    rows = 4 * matches
    size = source.stat().st_size
    check_disk_space(target.parent, SPARE_BYTES + 3 * size + 16 * rows)
    shutil.copyfile(source, target)


def _keys(xy: np.ndarray) -> np.ndarray:
    """Turn pixels (n, 2 or more) into one number each, equal where the float32 (x, y) are equal."""
    return xy[:, :2].astype(np.float32, order="C").view(np.uint64)[:, 0]


def _appended(known: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Add keypoints behind others, those that are not among them.

    Args:
      known: float32 (n, 2 or more): (x, y), and columns that are kept as they are.
      xy: float32 (m, 2), the keypoints to add.
    """
    fresh = np.unique(xy, axis=0)
    fresh = fresh[~np.isin(_keys(fresh), _keys(known))]
    rest = np.zeros((len(fresh), known.shape[1] - 2), np.float32)
    if rest.shape[1] >= 4:  # an affine shape: COLMAP writes the identity for a bare point
        rest[:, [0, 3]] = 1
    return np.concatenate([known, np.c_[fresh, rest]])


def _rows_of(xy: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """uint32 (n,): the (first) index of each pixel among keypoints, which include it."""
    keys = _keys(keypoints)
    order = np.argsort(keys, kind="stable")
    return order[np.searchsorted(keys, _keys(xy), sorter=order)].astype(np.uint32)


def add_matches(
    path: Path, results: Mapping[Pair, PairResult], options: VerificationOptions
) -> dict[Pair, int]:
    """Write matches into a database, and COLMAP's verification of them.

    The keypoints of an image stay, and new ones are added behind them.

    Args:
      results: of images that are in the database, for pairs that have no matches in it.

    Returns:
      number of inliers, by pair that has any.
    """
    ids = {name: image_id for name, (image_id, _) in read_images(path).items()}
    own: dict[str, list[Pair]] = {}
    for pair in sorted(results):
        for name in pair:
            own.setdefault(name, []).append(pair)
    rows: dict[Pair, list[np.ndarray]] = {}
    matches: dict[Pair, np.ndarray] = {}
    with changed(path) as db:
        for name in sorted(own):  # so the first name of a pair comes first
            parts = [_side(results[pair], pair.index(name)) for pair in own[name]]
            there = db.exists_keypoints(ids[name])
            known = np.asarray(db.read_keypoints(ids[name]), np.float32) if there else _NONE
            every = _appended(known if len(known) else _NONE, np.concatenate(parts))
            (db.update_keypoints if there else db.write_keypoints)(ids[name], every)
            found = _rows_of(np.concatenate(parts), every)
            ends = np.cumsum([len(xy) for xy in parts])[:-1]
            for pair, column in zip(own[name], np.split(found, ends), strict=True):
                rows.setdefault(pair, []).append(column)
        for pair in sorted(rows):
            both = np.stack(rows.pop(pair), axis=1)
            # Two cells may lie at one pixel. A keypoint keeps only its first match.
            for side in (0, 1):
                both = both[np.sort(np.unique(both[:, side], return_index=True)[1])]
            if len(both):
                matches[pair] = both
                db.write_matches(ids[pair[0]], ids[pair[1]], both)
    return _verified(path, matches, ids, options)


_NONE = np.zeros((0, 2), np.float32)


def _side(result: PairResult, side: int) -> np.ndarray:
    """float32 (n, 2): the keypoints of one side, in COLMAP's pixels."""
    xy = (result.keypoints0, result.keypoints1)[side]
    return np.asarray(xy, np.float32) + PIXEL_OFFSET


def _verified(
    path: Path,
    matches: Mapping[Pair, np.ndarray],
    ids: Mapping[str, int],
    options: VerificationOptions,
) -> dict[Pair, int]:
    """Verify new pairs alone.

    COLMAP verifies all pairs of a database, so this works in a copy that holds no other pairs.
    """
    if not matches:
        return {}
    scratch = path.with_name("new_pairs.db")
    shutil.copyfile(path, scratch)
    with changed(scratch) as db:
        db.clear_matches()
        db.clear_two_view_geometries()
        for (a, b), rows in matches.items():
            db.write_matches(ids[a], ids[b], rows)
    verify(scratch, options)
    found = {pair: view.geometry.num_inliers for pair, view in read_two_views(scratch).items()}
    with opened(scratch) as new, changed(path) as db:
        for a, b in matches:
            if new.exists_two_view_geometry(ids[a], ids[b]):
                geometry = new.read_two_view_geometry(ids[a], ids[b])
                db.write_two_view_geometry(ids[a], ids[b], geometry)
    scratch.unlink()
    return found
