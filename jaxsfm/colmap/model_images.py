"""The images of COLMAP's models: which ones they have, and models with fewer of them."""

import hashlib
from collections.abc import Collection, Iterable, Sequence

import numpy as np
import pycolmap

LEAST_NEW = 3
"""A model that shares images with larger ones has so many images of its own, or it is left out. Of
ten photos of castle-P19, a second model had four of the first model's nine, and the tenth: no photo
of it was right. An image that loses its place in this way can be registered in a larger model."""


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
