"""What is asked of COLMAP's models, and done to them in place: which images they have, fewer
images, another place in the world, and colours of their points."""

import hashlib
from collections.abc import Callable, Collection, Iterable, Sequence

import numpy as np
import pycolmap
from scipy.spatial import KDTree

from jaxsfm.io.images import ImageError, WorkingImage

LEAST_NEW = 3
"""A model that shares images with larger ones has so many images of its own, or it is left out. Of
ten photos of castle-P19, a second model had four of the first model's nine, and the tenth: no photo
of it was right. An image that loses its place in this way can be registered in a larger model."""

ASKED = 1000
"""So many points are enough for a median that is needed to a power of ten."""


def ordered(models: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """The models, the one with most images first, without those that bring few new images.

    In photos of repeated structure, COLMAP starts the same model again from other pairs: one run
    had seven models of the same 19 photos.
    """
    by_size = sorted(
        models, key=lambda m: (-m.num_reg_images(), -m.num_points3D(), min(m.reg_image_ids()))
    )
    kept: list[pycolmap.Reconstruction] = []
    for model in by_size:
        own = registered(model) - registered_in_any(kept)
        if len(own) >= min(LEAST_NEW, model.num_reg_images()):
            kept.append(model)
    return kept


def registered(model: pycolmap.Reconstruction) -> set[str]:
    """Names of the images that have a pose."""
    return {model.image(i).name for i in model.reg_image_ids()}


def registered_in_any(models: Iterable[pycolmap.Reconstruction]) -> set[str]:
    """Names of the images that have a pose in one of the models at least."""
    return {name for model in models for name in registered(model)}


def fingerprint(model: pycolmap.Reconstruction) -> str:
    """A hash of the images that have a pose, of their poses and cameras, and of the points."""
    found = hashlib.sha256()
    for k in sorted(model.reg_image_ids()):
        image = model.image(k)
        found.update(f"{k} {image.name} {image.camera_id}\n".encode())
        found.update(image.cam_from_world().matrix().tobytes())
        found.update(np.asarray(model.camera(image.camera_id).params).tobytes())
    for k in sorted(model.point3D_ids()):
        found.update(model.point3D(k).xyz.tobytes())
    return found.hexdigest()


def take_out(model: pycolmap.Reconstruction, names: Collection[str]) -> None:
    """Take the poses of images away, and the points that fewer than two images still see."""
    for k in sorted(model.reg_image_ids()):
        if model.image(k).name in names:
            model.deregister_frame(model.image(k).frame_id)


def part_of(model: pycolmap.Reconstruction, names: Collection[str]) -> pycolmap.Reconstruction:
    """A copy of a model with these images only, and the points that two of them see."""
    part = pycolmap.Reconstruction(model)
    take_out(part, registered(model) - set(names))
    return part


def move_model(
    model: pycolmap.Reconstruction, scale: float, rotation: np.ndarray, translation: np.ndarray
) -> None:
    """Apply x -> scale * rotation @ x + translation to poses and points, in place.

    Args:
      rotation: float64 (3, 3).
      translation: float64 (3,).
    """
    turned = pycolmap.Rotation3d(np.ascontiguousarray(rotation))
    model.transform(pycolmap.Sim3d(scale, turned, translation))


def forget_behind(model: pycolmap.Reconstruction) -> None:
    """Take out the observations of points behind cameras, and compute the errors of points anew.

    A solver moves points behind cameras, where COLMAP gives them an error of 1e154.
    """
    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
    model.update_point_3d_errors()


def usual_distance(model: pycolmap.Reconstruction) -> float:
    """The median distance from points to an image that observes them, world units; nan if there
    are no points. At most `ASKED` points are asked."""
    ids = sorted(model.point3D_ids())
    found = []
    for k in ids[:: max(1, len(ids) // ASKED)]:
        point = model.point3D(k)
        if point.track.length():
            image = model.image(point.track.elements[0].image_id)
            found.append(float(np.linalg.norm(point.xyz - image.projection_center())))
    return float(np.median(found)) if found else np.nan


def coloured(model: pycolmap.Reconstruction, points: np.ndarray, colours: np.ndarray) -> None:
    """Give every point of a model the colour of the nearest of other points, in place.

    Args:
      points: float64 (n, 3), world units.
      colours: uint8 (n, 3).
    """
    ids = sorted(model.point3D_ids())
    own = np.asarray([model.point3D(i).xyz for i in ids]).reshape(-1, 3)
    nearest = np.asarray(KDTree(points).query(own)[1])
    for i, row in zip(ids, nearest, strict=True):
        model.point3D(i).color = colours[row]


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
