"""Count the right matches of a night photo whose camera and pose are known."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.bench.scenes import Scene, Subset
from jaxsfm.colmap.database import read_matches
from jaxsfm.colmap.intrinsics import camera_of
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.two_views import rays_of

if TYPE_CHECKING:
    import pycolmap

CORRECT_PX = 4.0
"""The largest distance of a right match from the true epipolar line. In images of 1000 px height a
wrong match lies that close by chance in 1 of 100 cases."""


class NightMatches(NamedTuple):
    """The number of a night photo's verified matches, and how many of them are right."""

    number: int
    correct: int


def epipolar_distance(
    rays0: np.ndarray, rays1: np.ndarray, pose0: CameraPose, pose1: CameraPose
) -> np.ndarray:
    """The distance of each point in image 1 from the epipolar line of its partner in image 0.

    The unit is the focal length of image 1. The distance is nan for a ray in the image plane.

    Args:
      rays0, rays1: (n, 3), rays in the frames of the two cameras.

    Source: Hartley and Zisserman, 2nd edition, section 9.6 (x1' E x0 = 0, E = [t]x R).
    """
    rotation = pose1.rotation @ pose0.rotation.T
    t = pose1.rotation @ (pose0.centre - pose1.centre)
    line = np.cross(t, rays0 @ rotation.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = rays1 / rays1[:, 2:]
        return np.abs((line * at).sum(1)) / np.linalg.norm(line[:, :2], axis=1)


def night_matches(database: Path, scene: Scene, subset: Subset) -> NightMatches | None:
    """Count the verified matches of a subset's night photo in a COLMAP database.

    Matches with all day photos that have a reference pose are counted. The result is None if the
    camera or the night photo's pose is unknown.
    """
    if scene.camera is None or subset.night not in scene.truth:
        return None

    def camera(name: str) -> "pycolmap.Camera":
        assert scene.camera is not None
        return camera_of(scene.camera, scene.images[name]).camera(scene.images[name].size)

    night = camera(subset.night)
    number = correct = 0
    for name in subset.day:
        if name not in scene.truth:
            continue
        xy0, xy1 = read_matches(database, (name, subset.night), verified=True)
        if not len(xy0):
            continue
        far = night.mean_focal_length() * epipolar_distance(
            rays_of(camera(name), xy0),
            rays_of(night, xy1),
            scene.truth[name],
            scene.truth[subset.night],
        )
        number += len(far)
        correct += int((far <= CORRECT_PX).sum())
    return NightMatches(number, correct)
