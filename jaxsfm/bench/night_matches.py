"""Which of a night photo's matches are right, where cameras and poses are known."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.bench.scenes import Scene, Subset
from jaxsfm.colmap.database import read_matches
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.two_views import rays_of

CORRECT_PX = 4.0
"""From the true epipolar line. A wrong match lies that close by chance in 1 of 100 cases where the
images are 1000 px high."""


class NightMatches(NamedTuple):
    """Matches of a night photo with its day photos, as they go to the mapper."""

    number: int
    correct: int


def epipolar_distance(
    rays0: np.ndarray, rays1: np.ndarray, pose0: CameraPose, pose1: CameraPose
) -> np.ndarray:
    """Distance of each ray's point in image 1 from the epipolar line of its partner, in units of
    image 1's focal length; nan where a ray lies in the image plane.

    Args:
      rays0, rays1: (n, 3), in the cameras' frames.

    Source: Hartley and Zisserman, 2nd edition, section 9.6 (x1' E x0 = 0, E = [t]x R).
    """
    rotation = pose1.rotation @ pose0.rotation.T
    t = pose1.rotation @ (pose0.centre - pose1.centre)
    line = np.cross(t, rays0 @ rotation.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = rays1 / rays1[:, 2:]
        return np.abs((line * at).sum(1)) / np.linalg.norm(line[:, :2], axis=1)


def night_matches(database: Path, scene: Scene, subset: Subset) -> NightMatches | None:
    """Verified matches of the subset's night photo in a COLMAP database, summed over its day
    photos; None unless camera and poses are known.

    Day photos without a reference pose do not count.
    """
    if scene.camera is None or subset.night not in scene.truth:
        return None
    night = scene.camera.camera(scene.images[subset.night].size)
    number = correct = 0
    for name in subset.day:
        if name not in scene.truth:
            continue
        day = scene.camera.camera(scene.images[name].size)
        xy0, xy1 = read_matches(database, (name, subset.night), verified=True)
        if not len(xy0):
            continue
        far = night.mean_focal_length() * epipolar_distance(
            rays_of(day, xy0), rays_of(night, xy1), scene.truth[name], scene.truth[subset.night]
        )
        number += len(far)
        correct += int((far <= CORRECT_PX).sum())
    return NightMatches(number, correct)
