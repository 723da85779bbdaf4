"""Photos of rendered scenes that differ in light and sharpness, as ordinary photos do."""

import dataclasses
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.bench.synthetic import TexturedPlane, render
from jaxsfm.colmap.poses import CameraPose

SHADE = 0.6
"""The brightness of a shadow, as a share of the brightness of what is lit."""


class Look(NamedTuple):
    """What a camera does to a photo."""

    gain: float
    contrast: float
    slope: np.ndarray
    """By how much the gain grows from one side of the photo to the other, as a share: (x, y)."""
    blur: float
    """Standard deviation, pixels of a photo that is 400 pixels wide."""
    noise: float
    """Standard deviation, grey levels."""
    seed: int
    """The noise's seed."""


class OrdinaryScene(NamedTuple):
    """A scene, the cameras that photograph it, and how the photos differ."""

    planes: list[TexturedPlane]
    """Each is seen only from the side where its right is on the right."""
    sky: list[TexturedPlane]
    """Planes far behind everything, without texture."""
    poses: list[CameraPose]
    """In the order of the path, which is the order of the photos' names."""
    looks: list[Look]
    passers: list[TexturedPlane]
    """Somebody who passes by, in another place in each photo; empty if nobody does."""
    shadows: list[tuple[np.ndarray, float]]
    """In each photo, points with `normal @ point > offset` are in the shadow; empty if none is."""
    penumbra: float
    """The width of a shadow's edge, metres."""


def _shaded(scene: OrdinaryScene, plane: TexturedPlane, view: int) -> TexturedPlane:
    """A plane with the shadow that lies on it while a photo is taken."""
    normal, offset = scene.shadows[view]
    t, s = ((np.arange(n) + 0.5) / n for n in plane.texture.shape[:2])
    across = np.add.outer(normal @ plane.down * t, normal @ plane.right * s)
    beyond = (normal @ plane.corner - offset + across) / scene.penumbra
    light = 1 - (1 - SHADE) * np.clip(beyond + 0.5, 0, 1)
    texture = np.round(plane.texture * light[..., None]).astype(np.uint8)
    return dataclasses.replace(plane, texture=texture)


def planes_in(scene: OrdinaryScene, view: int) -> list[TexturedPlane]:
    """The planes that a photo may show: with their shadows, with who passes by, with the sky."""
    centre = scene.poses[view].centre
    planes = [p for p in scene.planes if (p.corner - centre) @ np.cross(p.right, p.down) > 0]
    if scene.shadows:
        planes = [_shaded(scene, plane, view) for plane in planes]
    return [*planes, *scene.passers[view : view + 1], *scene.sky]


def developed(rgb: np.ndarray, look: Look) -> np.ndarray:
    """What a camera makes of an exact image, both uint8 RGB."""
    height, width = rgb.shape[:2]
    image = rgb.astype(np.float32)
    if look.blur:
        image = cv2.GaussianBlur(image, (0, 0), look.blur * width / 400)
    y, x = (np.linspace(-0.5, 0.5, n) for n in (height, width))
    gain = look.gain * (1 + np.add.outer(look.slope[1] * y, look.slope[0] * x))
    image = gain[..., None] * (128 + look.contrast * (image - 128.0))
    noise = np.random.default_rng(look.seed).normal(0, look.noise, image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def ordinary_photo(scene: OrdinaryScene, view: int, size: tuple[int, int]) -> np.ndarray:
    """The photo with this index, uint8 RGB.

    Args:
      size: width and height of the photo, pixels.
    """
    return developed(render(planes_in(scene, view), scene.poses[view], size), scene.looks[view])
