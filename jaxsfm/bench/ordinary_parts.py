"""Textures, walls, boxes and paths, from which `jaxsfm.bench.ordinary` builds scenes, and photos.

The photos differ in light and sharpness, as ordinary photos do.

x points to the right, y down and z forward, in metres. The ground is at y = 0. A plane is seen only
from the side where its `right` is on the right.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.bench.synthetic import TexturedPlane, look_at, render
from jaxsfm.bench.walls import collage, moved, turn
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.sfm.evaluation import Similarity

EYES = -1.6
"""The y of the eyes of somebody who stands on the ground."""
SHADE = 0.6
"""The brightness of a shadow, as a share of the brightness of what is lit."""


@dataclasses.dataclass(frozen=True)
class Brush:
    """Paints textures, uint8 RGB; sizes are in metres."""

    rng: np.random.Generator
    density: float
    """Pixels per metre."""
    contrast: float

    def faded(self, canvas: np.ndarray, contrast: float) -> np.ndarray:
        """The canvas with less contrast and in another tint."""
        tint = self.rng.uniform(100, 175) + self.rng.uniform(-20, 20, 3)
        return np.clip(tint + contrast * (canvas - canvas.mean()), 0, 255).astype(np.uint8)

    def surface(self, width: float, height: float, *, contrast: float = 1.0) -> np.ndarray:
        """A texture that occurs only once; some surfaces show courses of bricks too."""
        columns, rows = (max(round(self.density * side), 8) for side in (width, height))
        canvas = self.faded(
            collage(int(self.rng.integers(2**31)), (columns, rows)), contrast * self.contrast
        )
        if self.rng.random() < 0.35:
            y, x = np.mgrid[:rows, :columns]
            course = y // 10
            mortar = (y % 10 == 0) | ((x + 12 * (course % 2)) % 24 == 0)
            darker = canvas * (1 - 0.4 * contrast * self.contrast)
            canvas[mortar] = darker.astype(np.uint8)[mortar]
        return canvas

    def element(self, width: float, height: float) -> np.ndarray:
        """A dark picture in a bright frame with bars: a window, a tile or a door."""
        columns, rows = (max(round(self.density * side), 6) for side in (width, height))
        pane = collage(int(self.rng.integers(2**31)), (columns, rows))
        canvas = (self.rng.uniform(0.4, 0.9) * pane).astype(np.uint8)
        edge = max(round(0.06 * min(columns, rows)), 1)
        bright = self.rng.uniform(150, 235, 3)
        for k in np.linspace(0, columns - edge, int(self.rng.integers(2, 4))).astype(int):
            canvas[:, k : k + edge] = bright
        for k in np.linspace(0, rows - edge, int(self.rng.integers(2, 5))).astype(int):
            canvas[k : k + edge] = bright
        return self.faded(canvas, min(1.2 * self.contrast, 1.0))

    def repeat(self, canvas: np.ndarray, element: np.ndarray, spacing: float) -> None:
        """Paste an element several times into a canvas, each slightly moved and slightly brighter.

        Args:
          spacing: the least from one to the next, in sizes of the element, 1.1 or more.
        """
        sides = np.asarray(element.shape[:2])
        counts = (np.asarray(canvas.shape[:2]) / (spacing * sides)).astype(int)
        cell = np.asarray(canvas.shape[:2]) / np.maximum(counts, 1)
        for index in np.ndindex(*counts):
            moved_by = self.rng.uniform(-0.04, 0.04, 2) * cell
            y, x = ((index + np.asarray(0.5)) * cell - sides / 2 + moved_by).astype(int)
            h, w = sides
            canvas[y : y + h, x : x + w] = np.clip(element * self.rng.uniform(0.93, 1.07), 0, 255)


def brush_for(rng: np.random.Generator, distance: float) -> Brush:
    """The brush for a scene that is photographed from this distance, with a contrast of its own."""
    # In a photo of 400 pixels, a pixel is then somewhat larger than one of the texture.
    return Brush(rng, 640 / distance, rng.uniform(0.35, 0.85))


def flat(
    x: tuple[float, float], z: tuple[float, float], y: float, texture: np.ndarray
) -> TexturedPlane:
    """A level rectangle that is seen from above."""
    right, down = np.asarray([x[1] - x[0], 0.0, 0.0]), np.asarray([0.0, 0.0, z[0] - z[1]])
    return TexturedPlane(
        corner=np.asarray([x[0], y, z[1]]), right=right, down=down, texture=texture
    )


def upright(
    start: Sequence[float], end: Sequence[float], top: float, bottom: float, texture: np.ndarray
) -> TexturedPlane:
    """A wall from `start` on the left to `end` on the right, which are (x, z)."""
    right = np.asarray([end[0] - start[0], 0.0, end[1] - start[1]])
    corner, down = np.asarray([start[0], top, start[1]]), np.asarray([0.0, bottom - top, 0.0])
    return TexturedPlane(corner=corner, right=right, down=down, texture=texture)


def walls(
    brush: Brush,
    corners: Sequence[tuple[float, float]],
    height: float,
    element: np.ndarray | None = None,
) -> list[TexturedPlane]:
    """Walls on the ground through corners (x, z), from left to right as they are seen.

    An element is pasted on those that have room for it.
    """
    planes = []
    for start, end in zip(corners, corners[1:], strict=False):
        length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
        canvas = brush.surface(length, height)
        if element is not None:
            brush.repeat(canvas, element, brush.rng.uniform(1.5, 2.1))
        planes.append(upright(start, end, -height, 0.0, canvas))
    return planes


def box(
    brush: Brush, size: np.ndarray, place: Similarity, top: np.ndarray | None = None
) -> list[TexturedPlane]:
    """A box on the ground of `size` (width, height, depth); `top` is the texture of its top."""
    x, h, z = size[0] / 2, size[1], size[2] / 2
    planes = walls(brush, [(-x, -z), (x, -z), (x, z), (-x, z), (-x, -z)], h)
    lid = brush.surface(2 * x, 2 * z) if top is None else top
    planes.append(flat((-x, x), (-z, z), -h, lid))
    return [moved(plane, place) for plane in planes]


def ground(brush: Brush) -> TexturedPlane:
    """A square of 36 metres at y = 0."""
    coarse = dataclasses.replace(brush, density=40.0)
    texture = cv2.GaussianBlur(coarse.surface(36.0, 36.0, contrast=0.5), (0, 0), 1.2)
    return flat((-18, 18), (-18, 18), 0.0, texture)


def sky(rng: np.random.Generator) -> list[TexturedPlane]:
    """A bright sky all around, and haze below the horizon."""
    height = np.linspace(1, -1, 128)[:, None]
    blue, white, haze = rng.uniform(140, 200), rng.uniform(215, 240), rng.uniform(150, 190)
    above = white + np.maximum(height, 0) * ([blue, 0.5 * (blue + 235), 240] - np.full(3, white))
    column = np.where(height > 0, above, haze + (white - haze) * np.exp(20 * np.minimum(height, 0)))
    texture = np.repeat(column.astype(np.uint8)[:, None], 4, axis=1)
    side = upright((-60, 60), (60, 60), -60, 60, texture)
    return [moved(side, turn(angle)) for angle in np.pi / 2 * np.arange(4)]


def place_at(x: float, z: float, angle: float = 0.0) -> Similarity:
    """A turn on the spot, then a move to (x, z)."""
    return Similarity(1.0, turn(angle).rotation, np.asarray([x, 0.0, z]))


def arc_around(
    rng: np.random.Generator, target: Sequence[float], distance: float, first: float, step: float
) -> list[CameraPose]:
    """Six to ten cameras on an arc around a point, each unlike the others.

    Args:
      target: the point they look at, but for a small deviation.
      first: the angle of the first camera, radians; at angle 0 it looks along z.
      step: from camera to camera, radians.
    """
    poses = []
    for k in range(rng.integers(6, 11)):
        angle = first + step * (k + rng.uniform(-0.15, 0.15))
        away = distance * rng.uniform(0.95, 1.05) * np.asarray([np.sin(angle), 0, -np.cos(angle)])
        # Centres near one line would leave the rotation about this line uncertain.
        away[1] = EYES - target[1] + (-1) ** k * rng.uniform(0.02, 0.05) * distance
        poses.append(look_at(target + away, target + rng.uniform(-0.03, 0.03, 3) * distance))
    return poses


def walk_along(
    rng: np.random.Generator, height: float, distance: float, oblique: float
) -> list[CameraPose]:
    """Six to ten cameras on a walk along z = 0, which look at the same height.

    Args:
      height: the y of what they look at, metres.
      oblique: how far ahead they look, as a share of the distance.
    """
    views, step = int(rng.integers(6, 11)), rng.uniform(0.1, 0.17) * distance
    poses = []
    for k in range(views):
        x = step * (k - (views - 1) / 2 + rng.uniform(-0.1, 0.1))
        y = EYES + (-1) ** k * rng.uniform(0.02, 0.05) * distance
        ahead = x + (oblique + rng.uniform(-0.03, 0.03)) * distance
        centre = np.asarray([x, y, -distance * rng.uniform(0.95, 1.05)])
        poses.append(look_at(centre, np.asarray([ahead, height + rng.uniform(-0.2, 0.2), 0.0])))
    return poses


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
