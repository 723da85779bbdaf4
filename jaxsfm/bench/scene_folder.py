"""Rendered scenes are written as folders in the layout of Strecha's sets."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jaxsfm.bench.synthetic import camera_matrix, camera_text, write_photo
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.io.atomic import atomic_folder


def write_scene_folder(
    folder: Path,
    poses: Sequence[CameraPose],
    photo: Callable[[int], np.ndarray],
    size: tuple[int, int],
) -> None:
    """Write a scene in the layout of Strecha's sets: images/ with K.txt, and gt_dense_cameras/.

    The photos are called view00.png, view01.png and so on, in the order of the poses. The folder is
    written whole or not at all.

    Args:
      photo: returns the photo of a pose, uint8 RGB of `size`, by the pose's index.
      size: width and height of the photos, pixels.
    """
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
