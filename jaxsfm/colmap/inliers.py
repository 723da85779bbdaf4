"""The two-view inliers in a COLMAP database, as arrays, and a database with some of them only."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.colmap.database import PIXEL_OFFSET, colmap_xy, image_ids
from jaxsfm.io.pairs import Pair


class ImageKeypoints(NamedTuple):
    """The keypoints of an image."""

    xy: np.ndarray
    """float (n, 2), original pixels; the centre of the top-left one is (0, 0)."""
    size: tuple[int, int]
    """Width and height, original pixels."""


class Inliers(NamedTuple):
    """The verified matches of all pairs."""

    keypoints: dict[str, ImageKeypoints]
    """By image, also of images without matches."""
    matches: dict[Pair, np.ndarray]
    """int64 (m, 2) for each verified pair: the index of each match's keypoint in either image."""


def read_inliers(path: Path) -> Inliers:
    """Read all keypoints and the two-view inliers of all pairs that have any."""
    with pycolmap.Database.open(path) as db:
        cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}
        images = {image.image_id: image for image in db.read_all_images()}
        keypoints = {}
        for image_id, image in images.items():
            camera = cameras[image.camera_id]
            keypoints[image.name] = ImageKeypoints(
                colmap_xy(db, image_id) - PIXEL_OFFSET, (camera.width, camera.height)
            )
        matches = {}
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            rows = np.asarray(geometry.inlier_matches).reshape(-1, 2).astype(np.int64)
            a, b = (images[k].name for k in pycolmap.pair_id_to_image_pair(pair_id))
            if len(rows):
                matches[(a, b) if a < b else (b, a)] = rows if a < b else rows[:, ::-1]
    return Inliers(keypoints, matches)


def keep_inliers(path: Path, kept: Mapping[Pair, np.ndarray]) -> None:
    """Keep some of the two-view inliers of pairs in a database. Their geometries stay as they are.

    Args:
      kept: for each pair, the rows of `Inliers.matches` to keep. Other pairs are not changed.
    """
    with pycolmap.Database.open(path) as db, pycolmap.DatabaseTransaction(db):
        ids = image_ids(db)
        for names, rows in kept.items():
            a, b = (ids[name] for name in names)
            geometry = db.read_two_view_geometry(a, b)
            geometry.inlier_matches = np.ascontiguousarray(rows, np.uint32)
            db.delete_two_view_geometry(a, b)
            db.write_two_view_geometry(a, b, geometry)
