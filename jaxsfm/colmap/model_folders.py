"""COLMAP models on disk, and the colours of their points."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.poses import read_model
from jaxsfm.io.atomic import SPARE_BYTES, check_disk_space
from jaxsfm.io.images import ImageError, WorkingImage


def write_models(models: list[pycolmap.Reconstruction], folder: Path) -> None:
    """Write models into `folder`/0 (the best one), 1, 2, ... The folder is replaced."""
    shutil.rmtree(folder, ignore_errors=True)
    for index, model in enumerate(models):
        target = folder / str(index)
        target.mkdir(parents=True)
        points2d = sum(image.num_points2D() for image in model.images.values())
        rows = 24 * points2d + 8 * model.compute_num_observations() + 51 * model.num_points3D()
        check_disk_space(target, SPARE_BYTES + rows)
        model.write_binary(target)


def read_models(folder: Path, database: Path) -> list[pycolmap.Reconstruction]:
    """Read what `write_models` wrote. Files are checked before COLMAP reads them.

    Args:
      database: of the same cameras. It says which focal lengths were known before mapping, which
        COLMAP's model files do not.

    Raises:
      UserError: a model is damaged.
    """
    with pycolmap.Database.open(database) as db:
        known = {c.camera_id: c.has_prior_focal_length for c in db.read_all_cameras()}
    models = []
    while (path := folder / str(len(models))).is_dir():
        model = read_model(path)
        for camera_id, camera in model.cameras.items():
            camera.has_prior_focal_length = known[camera_id]
        models.append(model)
    return models


def colour_points(model: pycolmap.Reconstruction, read: Callable[[str], WorkingImage]) -> None:
    """Give every 3-D point the mean colour of its observations, in place.

    A photo that cannot be read any more is left out.
    """
    total: dict[int, np.ndarray] = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        try:
            rgb, scale, _ = read(image.name)
        except ImageError:  # deleted since; other photos colour its points
            continue
        for point in image.points2D:
            if point.has_point3D():
                x, y = np.floor(point.xy / np.asarray(scale)).astype(int)
                x, y = min(max(x, 0), rgb.shape[1] - 1), min(max(y, 0), rgb.shape[0] - 1)
                value = np.append(rgb[y, x].astype(np.float64), 1.0)
                total[point.point3D_id] = total.get(point.point3D_id, 0.0) + value
    for point_id, value in total.items():
        model.point3D(point_id).color = np.round(value[:3] / value[3]).astype(np.uint8)
