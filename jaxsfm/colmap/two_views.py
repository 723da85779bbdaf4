"""COLMAP's two-view verification of the matches in a database, and its results."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.colmap.database import PIXEL_OFFSET, changed, colmap_xy, image_ids, opened
from jaxsfm.colmap.native import native
from jaxsfm.io.pairs import Pair

PLANAR = (4, 6)
"""The numbers of COLMAP's two-view configurations PLANAR and PLANAR_OR_PANORAMIC."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VerificationOptions:
    """Settings of COLMAP's two-view verification."""

    seed: int = 0
    threads: int = -1
    """-1 takes all cores."""
    scale: float = 1.0
    """Original pixels per working pixel. COLMAP's 4 px are multiplied by it."""
    relative_poses: bool = True
    """Also find the relative pose of every pair, which the view graph needs."""
    min_inliers: int | None = None
    """A pair with fewer inliers has none; None: COLMAP's 15."""

    def for_colmap(self) -> pycolmap.TwoViewGeometryOptions:
        """As COLMAP takes them."""
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = self.seed
        options.ransac.max_error *= self.scale
        options.compute_relative_pose = self.relative_poses
        if self.min_inliers is not None:
            options.min_num_inliers = self.min_inliers
        return options


def verify(path: Path, options: VerificationOptions) -> None:
    """Run COLMAP's own two-view verification on all pairs of a database (paper, section 4).

    Cameras with a known or prior focal length are verified as calibrated (essential matrices).
    """
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = options.threads
    native(
        lambda token: pycolmap.geometric_verification(
            path,
            verifier_options=verifier,
            two_view_geometry_options=options.for_colmap(),
            cancellation_token=token,
        ),
        path,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairGeometry:
    """The geometry of a verified pair, as the view graph uses it."""

    num_inliers: int
    rotation: np.ndarray | None
    """float64 (3, 3), from the camera of the first image to that of the second; None: unknown."""
    spread: float = 1.0
    """Share of the image that the inliers cover, 0 .. 1; the smaller of the two images' shares."""


def spread(xy: np.ndarray, size: tuple[int, int]) -> float:
    """The share of an 8 x 8 grid over an image (width, height) that has points, pixels (n, 2)."""
    at = np.floor((xy + 0.5) / np.asarray(size) * 8).astype(int).clip(0, 7)
    return len(np.unique(at[:, 1] * 8 + at[:, 0])) / 64


class TwoView(NamedTuple):
    """The result of COLMAP's verification for a pair."""

    geometry: PairGeometry
    tri_angle_deg: float
    """Median angle between the two rays of a point, degrees; 0 if unknown. The database does not
    hold COLMAP's own."""
    planar: bool
    """A homography explains all inliers."""


def rays_of(camera: pycolmap.Camera, xy: np.ndarray) -> np.ndarray:
    """Unit directions (n, 3) of original pixels (n, 2), in the camera's frame."""
    flat = camera.cam_from_img(np.ascontiguousarray(xy + float(PIXEL_OFFSET)))
    assert flat is not None
    rays = np.c_[flat, np.ones(len(flat))]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def read_two_views(path: Path) -> dict[Pair, TwoView]:
    """Every pair that has inliers, by pair of image names in order.

    Relative poses are known if `verify` was asked for them.
    """
    with opened(path) as db:
        images = {image.image_id: image for image in db.read_all_images()}
        cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}
        camera_of = {i: cameras[image.camera_id] for i, image in images.items()}
        xy = {i: colmap_xy(db, i) - PIXEL_OFFSET for i in images}
        found = {}
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            if not len(geometry.inlier_matches):
                continue
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            seen = [
                xy[i][geometry.inlier_matches[:, side]].astype(np.float64)
                for side, i in enumerate((a, b))
            ]
            covered = min(
                spread(at, (camera_of[i].width, camera_of[i].height))
                for at, i in zip(seen, (a, b), strict=True)
            )
            rotation, angle = None, 0.0
            if geometry.cam2_from_cam1 is not None:
                rotation = geometry.cam2_from_cam1.rotation.matrix()
                rays = [rays_of(camera_of[i], at) for at, i in zip(seen, (a, b), strict=True)]
                cross = np.linalg.norm(np.cross(rays[0] @ rotation.T, rays[1]), axis=1)
                seen_angles = np.arcsin(np.minimum(cross[np.isfinite(cross)], 1.0))
                angle = float(np.degrees(np.median(seen_angles))) if len(seen_angles) else 0.0
            if images[a].name > images[b].name:
                rotation = None if rotation is None else rotation.T
            name0, name1 = sorted((images[a].name, images[b].name))
            found[name0, name1] = TwoView(
                PairGeometry(
                    num_inliers=len(geometry.inlier_matches), rotation=rotation, spread=covered
                ),
                angle,
                int(geometry.config) in PLANAR,
            )
        return found


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
    with opened(path) as db:
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
    with changed(path) as db:
        ids = image_ids(db)
        for names, rows in kept.items():
            a, b = (ids[name] for name in names)
            geometry = db.read_two_view_geometry(a, b)
            geometry.inlier_matches = np.ascontiguousarray(rows, np.uint32)
            db.delete_two_view_geometry(a, b)
            db.write_two_view_geometry(a, b, geometry)
