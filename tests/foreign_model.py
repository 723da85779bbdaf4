"""A small model with exact observations and any cameras and names, and a run's folder with it."""

from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import write_database
from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairResult, exhaustive_pairs

NAMES = ["a.jpg", "sub/b.jpg", "sub/c.png", "z/sub/d.jpg"]
SIZE = (1024, 768)
CAMERAS = {
    "SIMPLE_PINHOLE": [900.0, 512, 384],
    "PINHOLE": [900.0, 950, 500, 390],
    "SIMPLE_RADIAL": [900.0, 512, 384, -0.08],
    "RADIAL": [900.0, 512, 384, -0.08, 0.03],
    "OPENCV": [900.0, 950, 500, 390, -0.08, 0.03, 0.004, -0.002],
    "SIMPLE_RADIAL_FISHEYE": [600.0, 512, 384, 0.02],
    "RADIAL_FISHEYE": [600.0, 512, 384, 0.02, -0.01],
    "OPENCV_FISHEYE": [600.0, 620, 500, 390, 0.02, -0.01, 0.003, -0.002],
}
"""COLMAP's camera models, each with parameters in COLMAP's pixels."""


def camera(model: str, camera_id: int = 1, params: list[float] | None = None) -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=camera_id,
        model=model,
        width=SIZE[0],
        height=SIZE[1],
        params=params or CAMERAS[model],
    )


def exact_model(
    cameras: list[pycolmap.Camera], names: list[str] = NAMES, points: int = 60
) -> pycolmap.Reconstruction:
    """Every image sees (nearly) every point; image k has camera k, the last one all that follow.

    A point's colour is its number; keypoints lie in an order of their own, some without a point.
    """
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-2, -1.5, 4], [2, 1.5, 7], (points, 3))
    model = pycolmap.Reconstruction()
    for each in cameras:
        model.add_camera_with_trivial_rig(each)
    tracks = [pycolmap.Track() for _ in xyz]
    for k, name in enumerate(names):
        own = cameras[min(k, len(cameras) - 1)]
        turn = pycolmap.Rotation3d(rng.normal(0, 0.05, 3))
        pose = pycolmap.Rigid3d(turn, [0.6 - 0.4 * k, 0.1 * k, 0.05 * k])
        local = np.asarray([pose * x for x in xyz])
        xy = own.img_from_cam(local)
        inside = np.flatnonzero(((xy > 0) & (xy < SIZE)).all(1))
        order = rng.permutation(inside)
        lone = rng.uniform(0, SIZE, (3, 2))
        image = pycolmap.Image(
            name=name,
            camera_id=own.camera_id,
            image_id=k + 1,
            keypoints=np.concatenate([lone, xy[order]]),
        )
        model.add_image_with_trivial_frame(image, pose)
        for place, point in enumerate(order):
            tracks[point].add_element(k + 1, place + len(lone))
    for number, (point, track) in enumerate(zip(xyz, tracks, strict=True)):
        assert track.length() > 1
        model.add_point3D(point, track, np.array([number % 256, number // 256, 7], np.uint8))
    return model


def image_files(names: list[str], folder: Path) -> list[ImageFile]:
    return [ImageFile(name=n, path=folder / n, size=SIZE, sha256=64 * "0") for n in names]


def results_of(
    model: pycolmap.Reconstruction, keep=lambda point_id: True
) -> dict[Pair, PairResult]:
    """The common points of every pair as matches; a cell is the point's id."""
    seen = {
        image.name: {
            p.point3D_id: p.xy - 0.5
            for p in image.points2D
            if p.has_point3D() and keep(p.point3D_id)
        }
        for image in model.images.values()
    }
    found = {}
    for a, b in exhaustive_pairs(seen):
        cells = np.asarray(sorted(seen[a].keys() & seen[b].keys()), np.int32)
        found[a, b] = PairResult(
            pair=(a, b),
            cells=np.stack([cells, cells], axis=1),
            keypoints0=np.asarray([seen[a][c] for c in cells], np.float32).reshape(-1, 2),
            keypoints1=np.asarray([seen[b][c] for c in cells], np.float32).reshape(-1, 2),
            plane=np.zeros(len(cells), np.int32),
            homographies=np.eye(3)[None],
            num_tentative=len(cells),
            num_dropped=0,
            status=Status.VERIFIED,
        )
    return found


def write_run(folder: Path, model: pycolmap.Reconstruction, *, with_model: bool = True) -> Path:
    """Write a finished run's folder; in its database the first pair lacks its last match."""
    folder.mkdir(parents=True, exist_ok=True)
    names = sorted(image.name for image in model.images.values())
    results = results_of(model)
    path = folder / "database.db"
    write_database(path, image_files(names, folder), results, Cameras(sharing="photo"))
    with pycolmap.Database.open(path) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        a, b = (ids[name] for name in min(results))
        inliers = np.asarray(db.read_matches(a, b))[:-1]
        geometry = pycolmap.TwoViewGeometry(config=2, inlier_matches=inliers)
        db.write_two_view_geometry(a, b, geometry)
    if with_model:
        (folder / "sparse" / "0").mkdir(parents=True)
        model.write_binary(folder / "sparse" / "0")
    return folder
