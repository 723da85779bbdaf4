"""Rendered scenes are written as folders in the layout of Strecha's sets."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.bench.synthetic import camera_matrix, camera_text, write_photo
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.io.atomic import atomic_folder


class ScenePhotos(NamedTuple):
    """The photos of a scene, which are rendered when they are asked for."""

    poses: Sequence[CameraPose]
    """In the order of the photos' names."""
    photo: Callable[[int], np.ndarray]
    """Returns the photo of a pose, uint8 RGB, by the pose's index."""


def check_scene(name: str, scenes: Collection[str]) -> None:
    """Raise ValueError unless there is a scene of this name."""
    if name not in scenes:
        raise ValueError(f"name must be one of {', '.join(scenes)}; got {name!r}")


def write_scene_folder(
    folder: Path, draw: Callable[[], ScenePhotos], size: tuple[int, int]
) -> None:
    """Write a scene in the layout of Strecha's sets: images/ with K.txt, and gt_dense_cameras/.

    The photos are called view00.png, view01.png and so on, in the order of the poses. The folder is
    written whole or not at all. A folder that is there already stays as it is.

    Args:
      draw: draws the scene.
      size: width and height of the photos, pixels.
    """
    if folder.is_dir():
        return
    poses, photo = draw()
    k = camera_matrix(size)
    # In these sets, pixels are counted from the corner of the top-left pixel, as COLMAP does.
    k[:2, 2] += 0.5
    with atomic_folder(folder) as fresh:
        images, cameras = fresh / "images", fresh / "gt_dense_cameras"
        images.mkdir()
        cameras.mkdir()
        np.savetxt(images / "K.txt", k, fmt="%.9g")
        for i, pose in enumerate(poses):
            name = f"view{i:02d}.png"
            write_photo(images / name, photo(i))
            (cameras / f"{name}.camera").write_text(camera_text(k, pose, size), encoding="ascii")
