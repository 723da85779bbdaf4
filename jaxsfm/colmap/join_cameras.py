"""Which cameras the photos of a second model get when it is joined to a first one."""

from collections.abc import Collection

import numpy as np
import pycolmap
from scipy.spatial import KDTree

from jaxsfm.colmap.model import Model


def joined_cameras(
    first: Model, second: Model, shared: Collection[str]
) -> dict[int, pycolmap.Camera]:
    """The camera that stands for each camera of the second model's views, by its id.

    If shared photos were taken with it, and all of these have one and the same camera in the first
    model, of the same kind and size, it is that camera. Otherwise it gets a new id.
    """
    own = {view.name: view.camera for view in first.views}
    used: dict[int, set[int]] = {}
    for view in second.views:
        partners = used.setdefault(view.camera.camera_id, set())
        if view.name in shared:
            partners.add(own[view.name].camera_id)
    cameras = {camera.camera_id: camera for camera in own.values()}
    theirs = {view.camera.camera_id: view.camera for view in second.views}
    fresh = max([*cameras, *first.cameras]) + 1
    joined = {}
    for camera_id in sorted(used):
        camera, partners = theirs[camera_id], used[camera_id]
        partner = cameras[min(partners)] if len(partners) == 1 else None
        if partner is not None and _alike(camera, partner):
            joined[camera_id] = partner
        else:
            joined[camera_id] = pycolmap.Camera({**camera.todict(), "camera_id": fresh})
            fresh += 1
    return joined


def _alike(a: pycolmap.Camera, b: pycolmap.Camera) -> bool:
    return (a.model, a.width, a.height) == (b.model, b.width, b.height)


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
