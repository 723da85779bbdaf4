"""Upright walls with textures of their own, from which `jaxsfm.bench.repeated` builds scenes."""

import zlib

import cv2
import numpy as np

from jaxsfm.bench.synthetic import TexturedPlane, photo_textures
from jaxsfm.sfm.evaluation import Similarity

HEIGHT = 4.0
"""The height of all walls, metres."""
TEXELS = 160
"""Resolution of the textures, pixels per metre. In photos of 640 pixels, a metre has about as many
pixels."""
PIECES = 14
"""Pieces of photographs in a square metre of a texture."""
SIDES = (1.2, 0.2)
"""The size of the largest and of the smallest pieces, metres."""
POSTER = (1.5, 0.5)
"""The most that a poster is wide, in metres and as a share of its wall's width."""
GAP = 0.002
"""The distance of a poster from its wall, metres."""


def turn(angle: float) -> Similarity:
    """A rotation about the vertical axis, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return Similarity(1.0, np.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.zeros(3))


def shift(x: float) -> Similarity:
    """A translation to the right, metres."""
    return Similarity(1.0, np.eye(3), np.asarray([x, 0.0, 0.0]))


def moved(plane: TexturedPlane, motion: Similarity) -> TexturedPlane:
    """The plane in another place, with the same texture."""
    return TexturedPlane(
        corner=motion.rotation @ plane.corner + motion.translation,
        right=motion.rotation @ plane.right,
        down=motion.rotation @ plane.down,
        texture=plane.texture,
    )


def collage(seed: int, size: tuple[int, int]) -> np.ndarray:
    """A texture of `size` (width, height) pixels, uint8 RGB: overlapping pieces of photographs.

    The largest pieces come first, so that pieces of all sizes remain visible. Textures of different
    seeds have different pieces in different places.
    """
    rng = np.random.default_rng(seed)
    photos = photo_textures()
    width, height = size
    canvas = cv2.resize(photos[rng.integers(len(photos))], size)
    count = round(PIECES * width * height / TEXELS**2)
    for side in TEXELS * np.geomspace(*SIDES, count):
        w, h = (int(side * rng.uniform(0.6, 1.6)) for _ in range(2))
        photo = photos[rng.integers(len(photos))]
        rows, cols = photo.shape[:2]
        cut = int(min(rows, cols) * rng.uniform(0.15, 0.5))
        top, left = rng.integers(rows - cut), rng.integers(cols - cut)
        piece = cv2.resize(photo[top : top + cut, left : left + cut], (w, h))
        tinted = np.clip(piece * rng.uniform(0.6, 1.3, 3), 0, 255).astype(np.uint8)
        x, y = rng.integers(-w // 2, width - w // 2), rng.integers(-h // 2, height - h // 2)
        x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + w, width), min(y + h, height)
        canvas[y0:y1, x0:x1] = tinted[y0 - y : y1 - y, x0 - x : x1 - x]
    return canvas


def wall(left: float, width: float, z: float, texture: np.ndarray) -> TexturedPlane:
    """An upright rectangle that is seen from smaller z, with the height of its texture."""
    height = texture.shape[0] / TEXELS
    return TexturedPlane(
        corner=np.asarray([left, -height / 2, z]),
        right=np.asarray([width, 0.0, 0.0]),
        down=np.asarray([0.0, height, 0.0]),
        texture=texture,
    )


def texture(rng: np.random.Generator, width: float, height: float = HEIGHT) -> np.ndarray:
    """A new texture for a wall of this size in metres, uint8 RGB."""
    size = (round(width * TEXELS), round(height * TEXELS))
    return collage(int(rng.integers(2**31)), size)


def posters(seed: int, motions: list[Similarity], first: TexturedPlane) -> list[TexturedPlane]:
    """A poster for each repeat except the last.

    Args:
      seed: seed of the pictures.
      motions: where each repeat is, seen from the first one.
      first: the wall of the first repeat, in front of which its poster hangs.
    """
    rng = np.random.default_rng([seed, zlib.crc32(b"posters")])
    most, share = POSTER
    width = min(most, share * float(np.linalg.norm(first.right)))
    z = float(first.corner[2]) - GAP
    hung = []
    for motion in motions[:-1]:
        poster = wall(-width / 2, width, z, texture(rng, width, 0.75 * most))
        hung.append(moved(poster, motion))
    return hung
