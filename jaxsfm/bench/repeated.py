"""Rendered scenes whose parts repeat exactly, with exact cameras, for `bench ambiguous`.

Four kinds of scene are drawn from a seed. In each, chains of photos with a common part join all
photos, so a right model exists. Photos of different repeats look the same, so pairs that have
nothing in common are matched too.

* `room`: two of four walls are equal and lie opposite each other. Seen from inside.
* `tower`: a prism of five to eight equal faces.
* `box`: a prism of four equal faces.
* `street`: equal houses in a row.

A poster is a rectangle with a picture of its own. A scene with posters has the same cameras and
textures as without. In `KIND-poster` there is one poster. In `KIND-posters` each repeat has its own
poster except the last. Photos of a room show which of its two walls they see if there is one
poster. With one poster on a prism or in a street, photos that do not show it remain ambiguous.

Nothing is lit, because light from one side would tell the repeats apart. Results on these scenes
must be called synthetic.
"""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.bench.synthetic import TexturedPlane, check_scene, look_at, render, write_scene_folder
from jaxsfm.bench.walls import moved, posters, shift, texture, turn, wall
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.sfm.evaluation import Similarity


class RepeatedScene(NamedTuple):
    """A scene with repeats and the cameras that photograph it."""

    planes: list[TexturedPlane]
    poses: list[CameraPose]
    """In the order of the path, which is the order of the photos' names."""
    step: Similarity
    """The motion that takes each repeat to the next, with scale 1."""
    repeats: int
    posters: list[TexturedPlane]
    """A poster for each repeat except the last. Those that hang are also among the planes."""
    facing: CameraPose
    """A camera that sees nothing but the first repeat and what repeats with it. It and `step` say
    what the scene promises, and serve its tests."""


def _around(
    rng: np.random.Generator, views: int, distance: float, ahead: float
) -> list[CameraPose]:
    """Cameras on a ring, each unlike the others, that look in the direction of the ring's centre.

    Args:
      distance: the ring's radius, metres.
      ahead: the distance of the point they look at from the ring's centre, on the far side.
    """
    poses = []
    for k in range(views):
        angle = 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / views
        ray = turn(angle).rotation @ np.asarray([0.0, 0.0, 1.0])
        centre = -distance * rng.uniform(0.9, 1.1) * ray + [0, rng.uniform(-0.7, 0.7), 0]
        poses.append(look_at(centre, ahead * ray + rng.uniform(-0.25, 0.25, 3)))
    return poses


def _room(rng: np.random.Generator, seed: int) -> RepeatedScene:
    width, depth = 8.0, rng.uniform(5.5, 6.5)
    equal = wall(-width / 2, width, depth / 2, texture(rng, width))
    ends = [wall(-depth / 2, depth, width / 2, texture(rng, depth)) for _ in range(2)]
    motions = [turn(0.0), turn(np.pi)]
    walls = [moved(equal, motion) for motion in motions]
    walls += [moved(ends[0], turn(np.pi / 2)), moved(ends[1], turn(-np.pi / 2))]
    poses = _around(rng, 18, 1.6, 2.0)
    facing = look_at(np.asarray([0.3, 0.1, -1.0]), np.asarray([0.0, 0.0, depth / 2]))
    hung = posters(seed, motions, equal)
    return RepeatedScene(walls, poses, motions[1], 2, hung, facing)


def _prism(rng: np.random.Generator, seed: int, faces: int) -> RepeatedScene:
    """A prism with faces at 1.6 to 2 metres from its axis, seen from outside."""
    apothem = rng.uniform(1.6, 2.0)
    width = 2 * apothem * np.tan(np.pi / faces)
    face = wall(-width / 2, width, -apothem, texture(rng, width))
    motions = [turn(2 * np.pi * k / faces) for k in range(faces)]
    walls = [moved(face, motion) for motion in motions]
    poses = _around(rng, max(20, 3 * faces), 2.6 * apothem, 0.0)
    facing = look_at(np.asarray([0.3, 0.1, -2.4 * apothem]), np.zeros(3))
    return RepeatedScene(walls, poses, motions[1], faces, posters(seed, motions, face), facing)


def _tower(rng: np.random.Generator, seed: int) -> RepeatedScene:
    return _prism(rng, seed, int(rng.integers(5, 9)))


def _box(rng: np.random.Generator, seed: int) -> RepeatedScene:
    return _prism(rng, seed, 4)


def _street(rng: np.random.Generator, seed: int) -> RepeatedScene:
    """Houses of 3 metres with gaps of 1 metre; the walk passes all but two at either end."""
    front, gap, depth = 3.0, 1.0, 1.2
    period, passed, hidden = front + gap, int(rng.integers(4, 7)), 2
    house = [
        wall(-front / 2, front, 0.0, texture(rng, front)),
        wall(front / 2, gap, depth, texture(rng, gap)),
    ]
    sides = [wall(0.0, depth, 0.0, texture(rng, depth)) for _ in range(2)]
    for side, x in zip(sides, (front / 2, -front / 2), strict=True):
        house.append(moved(moved(side, turn(-np.pi / 2)), shift(x)))
    motions = [shift(period * k) for k in range(passed)]
    everywhere = [shift(period * k) for k in range(-hidden, passed + hidden)]
    planes = [moved(each, motion) for motion in everywhere for each in house]
    poses = []
    stops = np.arange(0, period * (passed - 1) + 0.1, period / 2.9)
    for k, x in enumerate(stops):
        # Centres near one line would leave the rotation about this line uncertain.
        centre = np.asarray([x, (-1) ** k * rng.uniform(0.3, 0.9), -rng.uniform(4.0, 6.0)])
        centre[0] += rng.uniform(-0.3, 0.3)
        poses.append(look_at(centre, np.asarray([centre[0] + rng.uniform(-0.6, 0.6), 0.0, 0.0])))
    facing = look_at(np.asarray([0.3, 0.1, -4.5]), np.zeros(3))
    hung = posters(seed, motions, house[0])
    return RepeatedScene(planes, poses, shift(period), passed, hung, facing)


KINDS: dict[str, Callable[[np.random.Generator, int], RepeatedScene]] = {
    "room": _room,
    "tower": _tower,
    "box": _box,
    "street": _street,
}
PREFIX = "synthetic-"
SCENES = tuple(
    f"{PREFIX}{kind}{suffix}"
    for kind in KINDS
    for suffix in ("", "-poster", "-posters")
    if (kind, suffix) != ("room", "-posters")  # a room has one poster at most
)
"""The names of all scenes."""


def repeated_scene(name: str, seed: int) -> RepeatedScene:
    """Draw a scene.

    Args:
      name: one of `SCENES`.

    Raises:
      ValueError: there is no such scene.
    """
    check_scene(name, SCENES)
    kind, _, suffix = name.removeprefix(PREFIX).partition("-")
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    scene = KINDS[kind](rng, seed)
    hung = {"": 0, "poster": 1, "posters": len(scene.posters)}[suffix]
    return scene._replace(planes=[*scene.planes, *scene.posters[:hung]])


def write_repeated(folder: Path, name: str, seed: int, size: tuple[int, int]) -> None:
    """Write a scene that is called as in `SCENES` (`write_scene_folder`).

    A folder that is there already stays as it is.
    """
    if folder.is_dir():
        return
    scene = repeated_scene(name, seed)
    photos = (render(scene.planes, pose, size) for pose in scene.poses)
    write_scene_folder(folder, scene.poses, photos, size)
