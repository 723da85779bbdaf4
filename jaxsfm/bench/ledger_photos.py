"""The photos of the sets of `bench ledger`, in the layouts in which they come.

A function `as_...` is given the folder of a set's data and a folder of the set's own in which it
may write. It raises UserError if a photo, a camera or a pose cannot be read.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from PIL import Image

from jaxsfm.bench.frames import chosen_frames, linked
from jaxsfm.bench.strecha_sets import read_set
from jaxsfm.bench.synthetic import camera_text, write_photo
from jaxsfm.colmap.poses import CameraPose, Poses, read_poses
from jaxsfm.errors import UserError, writing
from jaxsfm.io.atomic import atomic_folder
from jaxsfm.io.photo_folder import find_images
from jaxsfm.sfm.evaluation import of_photos

QUARTER = np.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
"""Camera of an upright photo -> camera of the photo that is stored turned clockwise."""


class SetPhotos(NamedTuple):
    """The photos of a set as a run gets them."""

    photos: Path
    truth: Poses | None = None
    """The reference poses of these photos; None without any."""
    intrinsics: str | None = None
    """The value of `--intrinsics`; None: the cameras are not known."""
    pairs: str = "auto"


class DrawnScene(NamedTuple):
    """A rendered scene."""

    write: Callable[[Path, str, int, tuple[int, int]], None]
    """Takes a folder, which is written if it is not there, the name, the seed and the size."""
    name: str
    seed: int
    size: tuple[int, int]


def as_strecha(folder: Path, home: Path) -> SetPhotos:
    """A set in Strecha's layout; its camera is known."""
    del home
    found = read_set(folder)
    return SetPhotos(folder / "images", found.truth, found.camera, "exhaustive")


def as_frames(folder: Path, home: Path, *, every: int = 1, first: int | None = None) -> SetPhotos:
    """Photos with NAME.pose.txt and K.txt beside them; all, or links to each so-many-th one, or to
    so many first ones."""
    truth, camera, photos = read_poses(folder, option="--root"), str(folder / "K.txt"), folder
    if first is not None or every > 1:
        names = [path.name for path in chosen_frames(folder, every, 0).mapped[:first]]
        with writing(f"--out {home}"):
            photos = linked(folder, names, home / "photos")
        truth = of_photos(truth, names)
    return SetPhotos(photos, truth, camera)


def as_photos(folder: Path, home: Path) -> SetPhotos:
    """Photos of which nothing is known."""
    del home
    return SetPhotos(folder)


def as_photos_with_poses(folder: Path, home: Path) -> SetPhotos:
    """Photos with reference poses beside them."""
    del home
    return SetPhotos(folder, read_poses(folder, option="--root"))


def as_phototourism(folder: Path, home: Path) -> SetPhotos:
    """mapping/NAME.jpg, and ground_truth/calibration_NAME.h5 with x = K (R X + T)."""
    del home
    truth = {}
    for path in sorted((folder / "ground_truth").glob("calibration_*.h5")):
        try:
            with h5py.File(path, "r") as file:
                rotation = np.asarray(file["R"], np.float64)
                shift = np.asarray(file["T"], np.float64)
        except (OSError, KeyError) as error:
            raise UserError(f"--root: {path} is not a file with R and T of a camera") from error
        name = path.stem.removeprefix("calibration_")
        truth[name] = CameraPose(rotation, -rotation.T @ shift.reshape(3))
    return SetPhotos(folder / "mapping", truth or None)


def as_turned(folder: Path, home: Path) -> SetPhotos:
    """The photos of a set in Strecha's layout, every second of them stored turned clockwise.

    Nothing says so, and the cameras are not known. The poses are those of the stored photos.
    """
    scene = home / "scene"
    if not scene.is_dir():
        with writing(f"--out {scene}"):
            _write_turned(folder, scene)
    return SetPhotos(scene / "images", read_poses(scene, option="--out"))


def _write_turned(folder: Path, scene: Path) -> None:
    truth = read_set(folder).truth
    with atomic_folder(scene) as fresh:
        (fresh / "images").mkdir()
        (fresh / "gt_dense_cameras").mkdir()
        for k, name in enumerate(find_images(folder / "images")):
            ((_, pose),) = of_photos(truth, [name]).items()
            if k % 2:
                upright = np.asarray(Image.open(folder / "images" / name).convert("RGB"))
                name = f"{Path(name).stem}.png"
                stored = np.ascontiguousarray(np.rot90(upright, -1))
                write_photo(fresh / "images" / name, stored)
                pose = CameraPose(QUARTER @ pose.rotation, pose.centre)
            else:
                shutil.copyfile(folder / "images" / name, fresh / "images" / name)
            # Only the pose is read from this file.
            text = camera_text(np.eye(3), pose, (1, 1))
            path = fresh / "gt_dense_cameras" / f"{name}.camera"
            path.write_text(text, encoding="ascii")


def as_drawn(scene: DrawnScene, source: Path, home: Path) -> SetPhotos:
    """A rendered scene, in the folder `home`/scene."""
    del source
    folder = home / "scene"
    with writing(f"--out {folder}"):
        scene.write(folder, scene.name, scene.seed, scene.size)
    return as_strecha(folder, home)
