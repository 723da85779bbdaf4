"""A rendered town, walked with a 360-degree camera: panoramas with exact poses.

`python -m jaxsfm.bench.panorama_town FOLDER --panoramas 60` writes the panoramas (`panoramas/`) and
their exact poses (`truth.csv`, the table of `jaxsfm.colmap.panorama_poses`). The way leads once
round a block of houses, so the last panorama stands beside the first one. Every second panorama is
taken by evening light: dim and bluish, with lamps in the street. Results on it must be called
synthetic.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from jaxsfm.bench.long_street import turned, wall_of_pictures
from jaxsfm.bench.synthetic import SUPERSAMPLING, TexturedPlane, photo_textures
from jaxsfm.colmap.panorama_poses import write_panorama_table
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.core.panorama import panorama_directions

BLOCK, WALK, OUTER = 5.0, 9.0, 13.0
"""Half the side of the square of houses in the middle, of the way round it, and of the square of
houses around the way, metres."""
HOUSE = 5.0
"""The length of a house, metres, at most."""
GROUND, ROOF = 1.5, -4.5
"""Of the ground and of the roofs, metres below the camera."""
TILE = 64
"""Pixels: the panorama is rendered in squares of this side."""
SKY = np.asarray([[150, 180, 215], [215, 225, 235]], float)
"""The colour of the sky straight up and at the horizon."""
AMBIENT, LAMP = np.asarray([0.10, 0.13, 0.20]), np.asarray([1.1, 0.8, 0.5])
"""The light of the evening and of a lamp; 1 is daylight."""
LAMPS = [(x, z) for x in (-WALK, 0.0, WALK) for z in (-WALK, 0.0, WALK) if x or z]
REACH, LAMP_HEIGHT = 4.0, -2.5
"""Of a lamp, metres."""
ELECTRONS = 1500.0
"""Of a white pixel by evening light; their number has photon noise."""
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
    'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    'GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
)


def town(*, seed: int = 0) -> list[TexturedPlane]:
    """The houses on both sides of the way, a board before each, and the ground."""
    photos, rng = photo_textures(), np.random.default_rng(seed)
    planes = []
    for half, facing in ((BLOCK, 1), (OUTER, -1)):
        count = round(2 * half / HOUSE)
        for side in range(4):
            turn = turned(np.asarray([0, 90.0 * side, 0]))
            for edge in np.linspace(-half, half, count, endpoint=False):
                length = 2 * half / count
                out = rng.uniform(0, 0.6) * facing
                wall = wall_of_pictures(photos, rng, 4, 3)
                plane = (np.asarray([edge, ROOF, half + out]), [length, 0, 0], [0, 6.0, 0], wall)
                at = edge + rng.uniform(0.5, length - 1.5)
                board = np.asarray([at, rng.uniform(-0.6, 0.2), half + out + 1.2 * facing])
                lean = [0.9, 0, rng.uniform(-0.4, 0.4)]
                sign = (board, lean, [0, 1.2, 0], wall_of_pictures(photos, rng, 1, 1))
                planes += [_plane(turn, *each) for each in (plane, sign)]
    step = 2 * OUTER / 6
    for x in np.arange(-OUTER - step, OUTER + step, step):
        for z in np.arange(-OUTER - step, OUTER + step, step):
            corner = np.asarray([x, GROUND, z + step])
            texture = wall_of_pictures(photos, rng, 3, 3)
            planes.append(_plane(np.eye(3), corner, [step, 0, 0], [0, 0, -step], texture))
    return planes


def _plane(
    turn: np.ndarray,
    corner: np.ndarray,
    right: Sequence[float],
    down: Sequence[float],
    texture: np.ndarray,
) -> TexturedPlane:
    return TexturedPlane(
        corner=turn @ corner,
        right=turn @ np.asarray(right, float),
        down=turn @ np.asarray(down, float),
        texture=texture,
    )


def walk(panoramas: int, of: int | None = None, *, seed: int = 0) -> list[CameraPose]:
    """The first panoramas of a way round the block, which has `of` panoramas in all.

    The camera looks along the way, up to some 20 degrees, and is tilted by some 3 degrees.
    """
    rng, poses = np.random.default_rng([seed, 1]), []
    for k in range(panoramas):
        side, along = divmod(4 * k / (of or panoramas), 1)
        corner = turned(np.asarray([0, 90.0 * side, 0]))
        ahead = WALK * (2 * along - 1)
        jitter = rng.uniform(-0.5, 0.5, 3) * [1, 0.6, 1]
        centre = corner @ np.asarray([ahead, 0.0, WALK]) + jitter
        heading = 90.0 * (side + 1) + rng.normal(0, 20.0)
        tilt = turned(rng.normal(0, 3.0, 3) * [1, 0, 1])
        poses.append(CameraPose(tilt @ turned(np.asarray([0, heading, 0])).T, centre))
    return poses


def render_panorama(
    planes: Sequence[TexturedPlane], pose: CameraPose, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """A panorama, float64 (h, w, 3) RGB 0 .. 255, and how far away its pixels are, metres (h, w).

    Each square of pixels looks at the planes that may be in it, and at a level of their textures
    that is about as coarse as its pixels, so that far walls do not alias.
    """
    size, s = (width, width // 2), SUPERSAMPLING
    pyramids = [_pyramid(plane.texture) for plane in planes]
    cones = [_cone(_corners(plane) - pose.centre) for plane in planes]
    image, far = np.zeros((size[1], width, 3)), np.zeros((size[1], width))
    for top in range(0, size[1], TILE):
        for left in range(0, width, TILE):
            box = slice(top, min(top + TILE, size[1])), slice(left, min(left + TILE, width))
            y, x = ((np.arange(s * each.start, s * each.stop) + 0.5) / s - 0.5 for each in box)
            rays = panorama_directions(np.stack(np.meshgrid(x, y), axis=-1), size) @ pose.rotation
            middle, radius = _cone(rays[:: len(rays) - 1].reshape(-1, 3))
            seen = [
                (plane, pyramid)
                for plane, pyramid, (axis, wide) in zip(planes, pyramids, cones, strict=True)
                if np.arccos(np.clip(axis @ middle, -1, 1)) <= wide + radius + 0.05
                or max(wide, radius) > 1.5
            ]
            colour, depth = _cast(seen, pose.centre, rays, s * width / (2 * np.pi))
            rows = (colour.shape[0] // s, s, colour.shape[1] // s, s)
            image[box] = colour.reshape(*rows, 3).mean((1, 3))
            far[box] = depth.reshape(rows).min((1, 3))
    return image, far


def _corners(plane: TexturedPlane) -> np.ndarray:
    p = plane
    return np.stack([p.corner, p.corner + p.right, p.corner + p.down, p.corner + p.right + p.down])


def _cone(points: np.ndarray) -> tuple[np.ndarray, float]:
    """A direction, and the largest angle of points (n, 3) from it, radians."""
    units = points / np.linalg.norm(points, axis=1, keepdims=True)
    middle = units.mean(0)
    middle /= max(float(np.linalg.norm(middle)), 1e-9)
    return middle, float(np.arccos(np.clip(units @ middle, -1, 1)).max())


def _pyramid(texture: np.ndarray) -> list[np.ndarray]:
    levels = [texture]
    while min(levels[-1].shape[:2]) > 16:
        rows, columns = levels[-1].shape[:2]
        half = (columns // 2, rows // 2)
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return levels


def _cast(
    planes: Sequence[tuple[TexturedPlane, list[np.ndarray]]],
    centre: np.ndarray,
    rays: np.ndarray,
    density: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (h, w, 3) and distances (h, w) along unit rays (h, w, 3) of `density` a radian."""
    up = np.clip(-rays[..., 1:2], 0, 1)
    image = SKY[1] + up * (SKY[0] - SKY[1])
    nearest = np.full(rays.shape[:2], np.inf)
    for plane, pyramid in planes:
        normal = np.cross(plane.right, plane.down)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = ((plane.corner - centre) @ normal) / (rays @ normal)
            offset = centre + depth[..., None] * rays - plane.corner
        a = offset @ plane.right / (plane.right @ plane.right)
        b = offset @ plane.down / (plane.down @ plane.down)
        hit = (depth > 0) & (depth < nearest) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        if not hit.any():
            continue
        fine = pyramid[0].shape[1] / np.linalg.norm(plane.right)
        level = np.log2(max(fine * float(np.median(depth[hit])) / density, 1.0))
        texture = pyramid[min(round(level), len(pyramid) - 1)]
        rows, columns = texture.shape[:2]
        u = np.where(hit, a * columns - 0.5, 0).astype(np.float32)
        v = np.where(hit, b * rows - 0.5, 0).astype(np.float32)
        colour = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        image[hit], nearest[hit] = colour[hit], depth[hit]
    return image, nearest


def by_evening(
    image: np.ndarray, far: np.ndarray, pose: CameraPose, rng: np.random.Generator
) -> np.ndarray:
    """A panorama (`render_panorama`) by the light of lamps that stand in the street, with noise."""
    height, width = far.shape
    xy = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    rays = panorama_directions(xy, (width, height)) @ pose.rotation
    sky = np.isinf(far)
    points = pose.centre + np.where(sky, 1e3, far)[..., None] * rays
    light = np.broadcast_to(AMBIENT, image.shape).copy()
    for x, z in LAMPS:
        square = ((points - np.asarray([x, LAMP_HEIGHT, z])) ** 2).sum(-1)
        light += (1 / (1 + square / REACH**2) ** 2)[..., None] * LAMP
    electrons = rng.poisson((image / 255) ** 2.2 * light * ELECTRONS)
    return 255 * np.clip(electrons / ELECTRONS, 0, 1) ** (1 / 2.2)


def write_town(
    folder: Path, poses: Sequence[CameraPose], width: int, *, seed: int = 0, evening: bool = True
) -> None:
    """Write the panoramas of poses and `truth.csv`; panoramas that exist are kept.

    Args:
      evening: every second panorama is taken by evening light.
    """
    photos = folder / "panoramas"
    photos.mkdir(parents=True, exist_ok=True)
    names = [f"pano{k:03d}.jpg" for k in range(len(poses))]
    write_panorama_table(folder / "truth.csv", [dict(zip(names, poses, strict=True))])
    planes = town(seed=seed)
    for k, (name, pose) in enumerate(zip(names, poses, strict=True)):
        if (photos / name).exists():
            continue
        image, far = render_panorama(planes, pose, width)
        if evening and k % 2:
            image = by_evening(image, far, pose, np.random.default_rng([seed, 2, k]))
        rgb = Image.fromarray(np.clip(image + 0.5, 0, 255).astype(np.uint8))
        rgb.save(photos / name, quality=95, xmp=XMP.encode())


def main(arguments: list[str] | None = None) -> None:
    """Write a town's panoramas into a folder."""
    parser = argparse.ArgumentParser(prog="jaxsfm.bench.panorama_town", description=__doc__)
    parser.add_argument("folder", type=Path, help="where to write")
    parser.add_argument("--panoramas", type=int, default=60, help="how many (default: 60)")
    parser.add_argument("--of", type=int, help="how many a whole way has (default: all)")
    parser.add_argument("--width", type=int, default=2048, help="pixels (default: 2048)")
    given = parser.parse_args(arguments)
    write_town(given.folder, walk(given.panoramas, given.of), given.width)


if __name__ == "__main__":
    main()
