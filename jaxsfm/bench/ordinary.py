"""Rendered ordinary scenes with exact cameras, the counterpart of `jaxsfm.bench.repeated`.

Windows, posts, tiles, bricks and equal objects repeat in these scenes, but every photo shows much
that occurs only once. So exactly one right model exists, and a check that doubts it gives a false
alarm. Neighbours on the path have most of what they show in common.

* `facade`: a large facade with a grid of equal windows and a bay or a step.
* `fence`: a wall behind a row of equal posts.
* `room`: four different walls, seen from inside; some have equal windows.
* `table`: boxes, some of them equal, on a table with a pattern.
* `walk`: different houses with equal windows along a street.
* `aerial`: houses with equal roof tiles, seen from above on two strips of flight.
* `corner`: a walk around the corner of a building whose sides are different.
* `plaster`: walls of little contrast.

The photos differ in brightness and contrast, as ordinary photos do. In some scenes they are also
blurred or noisy, or somebody passes by, or the edge of a shadow moves between the photos. Results
on these scenes must be called synthetic.
"""

import dataclasses
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.bench.ordinary_parts import (
    Brush,
    Look,
    OrdinaryScene,
    arc_around,
    box,
    brush_for,
    flat,
    ground,
    ordinary_photo,
    place_at,
    sky,
    upright,
    walk_along,
    walls,
)
from jaxsfm.bench.synthetic import TexturedPlane, check_scene, look_at, write_scene_folder
from jaxsfm.bench.walls import moved
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.sfm.evaluation import Similarity

FROM_ABOVE = Similarity(1.0, np.asarray([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))
"""The rotation of a scene after which a camera that looks along z looks at the ground."""


class _Site(NamedTuple):
    """What a kind of scene draws."""

    planes: list[TexturedPlane]
    poses: list[CameraPose]
    distance: float
    """Of the cameras from what they look at, metres."""
    outdoors: bool = True


def _facade(rng: np.random.Generator) -> _Site:
    distance, height = rng.uniform(7.0, 9.0), rng.uniform(5.5, 7.5)
    brush = brush_for(rng, distance)
    window = brush.element(rng.uniform(0.8, 1.1), rng.uniform(1.1, 1.5))
    edge, width, bay = rng.uniform(-4, -1), rng.uniform(2.5, 5), rng.uniform(-1.2, 0.8)
    corners = [(-13.0, 0.0), (edge, 0.0), (edge, bay), (edge + width, bay)]
    corners += [(edge + width, 0.0), (13.0, 0.0)]
    planes = [*walls(brush, corners, height, window), ground(brush)]
    if rng.random() < 0.5:
        step = np.radians(rng.uniform(5, 8))
        poses = arc_around(rng, [0.0, -0.4 * height, 0.0], distance, -4 * step, step)
    else:
        poses = walk_along(rng, -0.4 * height, distance, rng.uniform(-0.2, 0.2))
    return _Site(planes, poses, distance)


def _fence(rng: np.random.Generator) -> _Site:
    distance, high = rng.uniform(5.5, 7.0), rng.uniform(1.2, 1.9)
    brush = brush_for(rng, distance)
    planes = [*walls(brush, [(-11.0, 0.0), (11.0, 0.0)], rng.uniform(3.5, 5)), ground(brush)]
    width, front = rng.uniform(0.08, 0.14), -rng.uniform(0.25, 0.35) * distance
    post = brush.element(width, high)
    for x in np.arange(-6, 6, rng.uniform(0.45, 0.8)):
        left, right = (x + rng.uniform(-0.02, 0.02) + side for side in (0, width))
        planes.append(upright((left, front), (right, front), -high, 0.0, post))
    return _Site(planes, walk_along(rng, -1.6, distance, rng.uniform(-0.1, 0.1)), distance)


def _room(rng: np.random.Generator) -> _Site:
    x, z, height = rng.uniform(3, 4), rng.uniform(2.6, 3.4), rng.uniform(2.6, 3.2)
    brush = brush_for(rng, 4.5)
    window = brush.element(rng.uniform(0.6, 0.9), rng.uniform(0.8, 1.1))
    corners = [(-x, -z), (-x, z), (x, z), (x, -z), (-x, -z)]
    planes = walls(brush, corners[:3], height) + walls(brush, corners[2:], height, window)
    planes.append(flat((-x, x), (-z, z), 0.0, brush.surface(2 * x, 2 * z)))
    ceiling = brush.surface(2 * x, 2 * z, contrast=0.4)
    planes.append(flat((-x, x), (z, -z), -height, ceiling))
    for angle in rng.uniform(0, 2 * np.pi) + np.asarray([0, 2.2, 4.1]):
        place = place_at((x - 0.6) * np.cos(angle), (z - 0.6) * np.sin(angle), angle)
        planes += box(brush, rng.uniform(0.5, 1.0, 3), place)
    step = np.radians(rng.uniform(9, 13))
    poses = arc_around(rng, [0.0, -1.3, 0.0], rng.uniform(1.4, 2), rng.uniform(0, 2 * np.pi), step)
    return _Site(planes, poses, 4.0, outdoors=False)


def _table(rng: np.random.Generator) -> _Site:
    distance, half = rng.uniform(4.5, 5.5), rng.uniform(1.9, 2.3)
    brush = brush_for(rng, distance)
    cloth = brush.surface(2 * half, 2 * half)
    brush.repeat(cloth, brush.element(0.3, 0.3), rng.uniform(1.8, 2.4))
    planes = [flat((-half, half), (-half, half), 0.0, cloth)]
    equal = box(brush, rng.uniform(0.4, 0.7, 3), place_at(0, 0))
    for k, angle in enumerate(rng.uniform(0, 2 * np.pi) + np.pi / 3 * np.arange(6)):
        x, z = rng.uniform(0.5, 0.75) * half * np.asarray([np.cos(angle), np.sin(angle)])
        place = place_at(x, z, rng.uniform(0, 2 * np.pi))
        if k % 3 == 0:
            planes += [moved(plane, place) for plane in equal]
        else:
            planes += box(brush, rng.uniform(0.4, 1.1, 3), place)
    far = dataclasses.replace(brush, density=60.0, contrast=0.6 * brush.contrast)
    around = walls(far, [(-8, -8), (-8, 8), (8, 8), (8, -8), (-8, -8)], 8.0)
    below = Similarity(1.0, np.eye(3), np.asarray([0.0, 2.5, 0.0]))
    floor = flat((-8, 8), (-8, 8), 0.0, far.surface(16, 16))
    planes += [moved(plane, below) for plane in [*around, floor]]
    first, step = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(6, 9))
    poses = arc_around(rng, [0.0, 0.0, 0.0], distance, first, step)
    rise = np.asarray([0.0, rng.uniform(-1.6, -0.4), 0.0])
    poses = [look_at(p.centre + rise, p.centre + distance * p.rotation[2]) for p in poses]
    return _Site(planes, poses, distance, outdoors=False)


def _walk(rng: np.random.Generator) -> _Site:
    distance = rng.uniform(5.0, 6.5)
    brush = brush_for(rng, distance)
    window = brush.element(rng.uniform(0.7, 1.0), rng.uniform(0.9, 1.3))
    planes, x, z = [ground(brush)], -13.0, 0.0
    while x < 13:
        width, back = rng.uniform(2.5, 4.5), rng.uniform(0.0, 1.0)
        # The first wall joins the house to the one before.
        corners = [(x, z), (x, back), (x + width, back)]
        planes += walls(brush, corners, rng.uniform(3.5, 5.5), window)
        x, z = x + width, back
    poses = walk_along(rng, -1.9, distance, rng.choice([-1, 1]) * rng.uniform(0.1, 0.4))
    return _Site(planes, poses, distance)


def _aerial(rng: np.random.Generator) -> _Site:
    height = rng.uniform(15.0, 18.0)
    brush = brush_for(rng, height)
    planes = [flat((-25, 25), (-22, 22), 0.0, brush.surface(50, 44))]
    tile = brush.element(0.5, 0.5)
    for x, z in [(-9, -4), (-4, 3), (-2, -5), (4, -2), (5, 5), (10, -6), (11, 2), (-10, 6)]:
        size = rng.uniform([2.0, 1.5, 2.0], [4.5, 3.5, 4.5])
        roof = brush.surface(size[0], size[2])
        brush.repeat(roof, tile, rng.uniform(1.3, 1.7))
        place = place_at(x + rng.uniform(-1, 1), z + rng.uniform(-1, 1), rng.uniform(0, np.pi))
        planes += box(brush, size, place, roof)
    columns, step = int(rng.integers(3, 6)), rng.uniform(0.12, 0.2) * height
    oblique = rng.choice([0.0, 0.4]) * height
    poses = []
    for row, y in enumerate((-0.09 * height, 0.09 * height)):
        # The second strip is flown back.
        for x in step * (np.arange(columns) - (columns - 1) / 2) * (-1) ** row:
            centre = np.asarray([x, y + oblique, -height]) + rng.uniform(-0.4, 0.4, 3)
            poses.append(look_at(centre, np.asarray([x, y, 0]) + rng.uniform(-0.4, 0.4, 3)))
    return _Site([moved(plane, FROM_ABOVE) for plane in planes], poses, height)


def _corner(rng: np.random.Generator) -> _Site:
    distance, height = rng.uniform(6.5, 8.0), rng.uniform(5.0, 7.0)
    brush = brush_for(rng, distance)
    window = brush.element(rng.uniform(0.7, 1.0), rng.uniform(1.0, 1.4))
    z = rng.uniform(5.0, 8.0)
    planes = [*walls(brush, [(-7, z), (0, 0), (7, z)], height, window), ground(brush)]
    step = np.radians(rng.uniform(6, 9))
    poses = arc_around(rng, [0.0, -0.4 * height, 0.5], distance, -4 * step, step)
    return _Site(planes, poses, distance)


def _plaster(rng: np.random.Generator) -> _Site:
    distance = rng.uniform(6.0, 7.5)
    brush = dataclasses.replace(brush_for(rng, distance), contrast=rng.uniform(0.12, 0.2))
    window = brush.element(rng.uniform(0.7, 1.0), rng.uniform(0.9, 1.2))
    depth = rng.uniform(1.0, 2.5)
    corners = [(-11, -depth), (rng.uniform(-1.5, 1.5), depth), (11, -depth)]
    planes = [*walls(brush, corners, rng.uniform(4.5, 6), window), ground(brush)]
    return _Site(planes, walk_along(rng, -2.0, distance, rng.uniform(-0.15, 0.15)), distance)


KINDS: dict[str, Callable[[np.random.Generator], _Site]] = {
    "facade": _facade,
    "fence": _fence,
    "room": _room,
    "table": _table,
    "walk": _walk,
    "aerial": _aerial,
    "corner": _corner,
    "plaster": _plaster,
}
PREFIX = "ordinary-"
SCENES = tuple(f"{PREFIX}{kind}" for kind in KINDS)
"""The names of all scenes."""


def _passers(rng: np.random.Generator, site: _Site) -> list[TexturedPlane]:
    """Somebody in another place before each camera, who covers about a tenth of the photo."""
    size = np.asarray([0.09, 0.28]) * site.distance
    texture = Brush(rng, 1000 / site.distance, 0.5).surface(*size)
    passers = []
    for pose in site.poses:
        depth = rng.uniform(0.45, 0.65) * site.distance
        middle = np.asarray([rng.uniform(-0.4, 0.4), rng.uniform(0.0, 0.15), 1]) * depth
        corner = pose.centre + (middle - [*size / 2, 0]) @ pose.rotation
        right, down = size[:, None] * pose.rotation[:2]
        passers.append(TexturedPlane(corner=corner, right=right, down=down, texture=texture))
    return passers


def _shadows(rng: np.random.Generator, site: _Site) -> list[tuple[np.ndarray, float]]:
    """The edge of a shadow in another place in each photo."""
    normal = rng.normal(0, 1, 3)
    normal /= np.linalg.norm(normal)
    seen = [pose.centre + site.distance * pose.rotation[2] for pose in site.poses]
    return [(normal, normal @ p + rng.uniform(-0.2, 0.2) * site.distance) for p in seen]


def ordinary_scene(name: str, seed: int) -> OrdinaryScene:
    """Draw a scene.

    Args:
      name: one of `SCENES`.

    Raises:
      ValueError: there is no such scene.
    """
    check_scene(name, SCENES)
    kind = name.removeprefix(PREFIX)
    rng, light = (
        np.random.default_rng([seed, zlib.crc32(kind.encode()), part]) for part in range(2)
    )
    site = KINDS[kind](rng)
    blur, noise = (light.choice([0, 1]) * most for most in (0.8, 4.0))
    looks = [
        Look(
            gain=float(np.exp(light.uniform(np.log(0.8), np.log(1.25)))),
            contrast=light.uniform(0.9, 1.1),
            slope=light.uniform(-0.15, 0.15, 2),
            blur=blur * light.uniform(0.3, 1),
            noise=noise * light.uniform(0.5, 1),
            seed=int(light.integers(2**31)),
        )
        for _ in site.poses
    ]
    passed, shaded = light.random(2) < [0.35, 0.3]
    return OrdinaryScene(
        site.planes,
        sky(light) if site.outdoors else [],
        site.poses,
        looks,
        _passers(light, site) if passed else [],
        _shadows(light, site) if shaded else [],
        0.03 * site.distance,
    )


def write_ordinary(folder: Path, name: str, seed: int, size: tuple[int, int]) -> None:
    """Write a scene that is called as in `SCENES` (`write_scene_folder`).

    A folder that is there already stays as it is.
    """
    if folder.is_dir():
        return
    scene = ordinary_scene(name, seed)
    photos = (ordinary_photo(scene, i, size) for i in range(len(scene.poses)))
    write_scene_folder(folder, scene.poses, photos, size)
