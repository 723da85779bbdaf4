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

from jaxsfm.colmap.formats.lens import Lens, lens_of, registered_images
from jaxsfm.errors import UserError

TRANSFORMS, POINTS, IMAGES = "transforms.json", "sparse_pc.ply", "images"
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""From the world to nerfstudio's world."""


def _intrinsics(lens: Lens) -> dict[str, float]:
    names = ("k1", "k2", "k3", "k4") if lens.fisheye else ("k1", "k2")
    return {
        "w": lens.size[0],
        "h": lens.size[1],
        "fl_x": lens.fx,
        "fl_y": lens.fy,
        "cx": lens.cx,
        "cy": lens.cy,
        **dict(zip(names, lens.radial, strict=False)),
        **({} if lens.fisheye else {"p1": lens.tangential[0], "p2": lens.tangential[1]}),
    }


def write_nerfstudio(folder: Path, model: pycolmap.Reconstruction, images: Path | None) -> None:
    """Write transforms.json and sparse_pc.ply.

    Args:
      images: the photos' folder, as the file refers to it; None: `images` beside the file.

    Raises:
      UserError: nerfstudio does not have a camera, or perspective and fisheye cameras are mixed.
    """
    views = registered_images(model)
    lenses = [lens_of(model.camera(view.camera_id), "nerfstudio") for view in views]
    if len({lens.fisheye for lens in lenses}) > 1:
        kinds = ", ".join(sorted({lens.model for lens in lenses}))
        raise UserError(f"--to nerfstudio: one kind of camera for all images; got {kinds}")
    shared = len(set(lenses)) == 1
    frames = []
    for view, lens in zip(views, lenses, strict=True):
        world_from_cam = np.vstack([view.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
        world_from_cam[:3, 1:3] *= -1
        placed = np.vstack([APPLIED @ world_from_cam, [0, 0, 0, 1]])
        where = (images / view.name).as_posix() if images else f"{IMAGES}/{view.name}"
        frame = {"file_path": where, "transform_matrix": placed.tolist()}
        frames.append(frame if shared else frame | _intrinsics(lens))
    fisheye = bool(lenses) and lenses[0].fisheye
    record = {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        **(_intrinsics(lenses[0]) if shared else {}),
        "frames": frames,
        "applied_transform": APPLIED.tolist(),
        "ply_file_path": POINTS,
    }
    (folder / TRANSFORMS).write_text(json.dumps(record, indent=1), encoding="utf-8", newline="\n")
    turned = pycolmap.Reconstruction(model)
    turned.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(APPLIED[:, :3]), np.zeros(3)))
    turned.export_PLY(folder / POINTS)
