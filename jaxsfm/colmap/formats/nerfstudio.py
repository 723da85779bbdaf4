"""Writes nerfstudio's transforms.json and its point cloud.

Source: nerfstudio's data conventions and its own converter (process_data/colmap_utils.py).
Cameras to world, OpenGL's axes (x right, y up, looking along -z); the world is turned as their
converter turns it (`applied_transform`: x, z, -y), and so are the points of `ply_file_path`. Pixels
are COLMAP's: rays leave through (column + 0.5, row + 0.5) (cameras.py, `get_image_coords`).
"""

import json
from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.formats.tables import registered_images
from jaxsfm.errors import UserError

TRANSFORMS, POINTS, IMAGES = "transforms.json", "sparse_pc.ply", "images"
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""From the world to nerfstudio's world."""
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
_DISTORTION = {"OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}
"""The distortion of nerfstudio's camera models. COLMAP's simpler models have the first terms of it,
in the same order."""


def _model_of(camera: pycolmap.Camera) -> str:
    """nerfstudio's model of a camera; UserError if it has none."""
    if camera.model_name in _PERSPECTIVE:
        return "OPENCV"
    if camera.model_name in _FISHEYE:
        return "OPENCV_FISHEYE"
    raise UserError(f"--to nerfstudio: it has no camera like COLMAP's {camera.model_name}")


def _intrinsics(camera: pycolmap.Camera) -> dict[str, float]:
    terms = dict.fromkeys(_DISTORTION[_model_of(camera)], 0.0)
    given = [float(camera.params[k]) for k in camera.extra_params_idxs()]
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.focal_length_x),
        "fl_y": float(camera.focal_length_y),
        "cx": float(camera.principal_point_x),
        "cy": float(camera.principal_point_y),
        **terms,
        **dict(zip(terms, given, strict=False)),
    }


def write_nerfstudio(folder: Path, model: pycolmap.Reconstruction, images: Path | None) -> None:
    """Write transforms.json and sparse_pc.ply.

    Args:
      images: the photos' folder, as the file refers to it; None: `images` beside the file.

    Raises:
      UserError: nerfstudio does not have a camera, or perspective and fisheye cameras are mixed.
    """
    views = registered_images(model)
    cameras = [model.camera(view.camera_id) for view in views]
    kinds = {_model_of(camera) for camera in cameras}
    if len(kinds) > 1:
        names = ", ".join(sorted({camera.model_name for camera in cameras}))
        raise UserError(f"--to nerfstudio: one kind of camera for all images; got {names}")
    lenses = [_intrinsics(camera) for camera in cameras]
    shared = bool(lenses) and all(lens == lenses[0] for lens in lenses)
    frames = []
    for view, lens in zip(views, lenses, strict=True):
        world_from_cam = np.vstack([view.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
        world_from_cam[:3, 1:3] *= -1
        placed = np.vstack([APPLIED @ world_from_cam, [0, 0, 0, 1]])
        where = (images / view.name).as_posix() if images else f"{IMAGES}/{view.name}"
        frame = {"file_path": where, "transform_matrix": placed.tolist()}
        frames.append(frame if shared else frame | lens)
    record = {
        "camera_model": next(iter(kinds), "OPENCV"),
        **(lenses[0] if shared else {}),
        "frames": frames,
        "applied_transform": APPLIED.tolist(),
        "ply_file_path": POINTS,
    }
    (folder / TRANSFORMS).write_text(json.dumps(record, indent=1), encoding="utf-8", newline="\n")
    turned = pycolmap.Reconstruction(model)
    turned.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(APPLIED[:, :3]), np.zeros(3)))
    turned.export_PLY(folder / POINTS)
