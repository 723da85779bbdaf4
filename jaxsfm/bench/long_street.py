"""A rendered street that is as long as it has photos, to measure how the time of a run grows.

`python -m jaxsfm.bench.long_street FOLDER --photos 1000` writes the photos (`images/`), the exact
cameras (`reference/`, Strecha's format) and `K.txt`. Each photo sees as much of the street as any
other one, so only the number of photos differs between a short street and a long one. The pictures
on the walls are parts of nine photographs, so a picture may look like another one elsewhere.
Results on it must be called synthetic.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from jaxsfm.bench.synthetic import (
    TexturedPlane,
    camera_matrix,
    camera_text,
    photo_textures,
    render,
    write_photo,
)
from jaxsfm.colmap.poses import CameraPose

SIZE = (240, 180)
"""Of a photo. It is small so that a thousand photos take minutes."""
STEP = 0.35
"""From photo to photo, metres: 1000 photos are 350 m."""
DEPTH = 5.0
"""The distance of the wall, metres. A photo shows 5 m of it, so 13 photos later it shows the next
part."""
HOUSE = 5.0
"""The length of a house, metres. Each has a texture and a board of its own."""
TILE = 200
"""Of the pictures on a wall, pixels."""


def _picture(photos: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """A part of one of the photographs, in colours of its own: uint8 (TILE, TILE, 3)."""
    photo = photos[rng.integers(len(photos))]
    side = int(min(photo.shape[:2]) * rng.uniform(0.3, 0.8))
    y, x = (int(rng.integers(n - side + 1)) for n in photo.shape[:2])
    part = cv2.resize(photo[y : y + side, x : x + side], (TILE, TILE), interpolation=cv2.INTER_AREA)
    part = part[:, :, rng.permutation(3)]
    if rng.random() < 0.5:
        part = part[:, ::-1]
    return np.clip(part * rng.uniform(0.6, 1.2, 3), 0, 255).astype(np.uint8)


def wall_of_pictures(
    photos: list[np.ndarray], rng: np.random.Generator, rows: int, columns: int
) -> np.ndarray:
    """A texture of rows x columns pictures, uint8 RGB."""
    grid = [[_picture(photos, rng) for _ in range(columns)] for _ in range(rows)]
    return np.concatenate([np.concatenate(row, axis=1) for row in grid])


def houses(metres: float, *, seed: int = 0) -> list[TexturedPlane]:
    """The walls, the ground and a board before each wall, for a street of this length; x is along
    the street, y down, z towards the walls."""
    photos, rng = photo_textures(), np.random.default_rng(seed)
    v = lambda *xyz: np.asarray(xyz, float)  # noqa: E731
    planes = []
    for x in np.arange(-HOUSE, metres + 2 * HOUSE, HOUSE):
        back = DEPTH + rng.uniform(0, 1.0)
        planes += [
            TexturedPlane(
                corner=v(x, -3, back),
                right=v(HOUSE, 0, 0),
                down=v(0, 4.5, 0),
                texture=wall_of_pictures(photos, rng, 3, 3),
            ),
            TexturedPlane(
                corner=v(x, 1.5, back),
                right=v(HOUSE, 0, 0),
                down=v(0, 0, -4),
                texture=wall_of_pictures(photos, rng, 2, 3),
            ),
            TexturedPlane(
                corner=v(x + rng.uniform(0.5, 3.5), rng.uniform(-0.6, 0.2), DEPTH - 1),
                right=v(0.9, 0, rng.uniform(-0.3, 0.3)),
                down=v(0, 1.2, 0),
                texture=wall_of_pictures(photos, rng, 1, 1),
            ),
        ]
    return planes


def turned(degrees: np.ndarray) -> np.ndarray:
    """A small turn, float64 (3, 3), from degrees about x, y and z."""
    return cv2.Rodrigues(np.radians(np.asarray(degrees, float)))[0]


def walk(photos: int, *, seed: int = 0) -> list[CameraPose]:
    """The cameras: steps along the street, at changing heights and with small turns."""
    rng = np.random.default_rng([seed, 1])
    poses = []
    for k in range(photos):
        centre = np.asarray([STEP * k, rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4)])
        poses.append(CameraPose(turned(rng.normal(0, 3.0, 3)), centre))
    return poses


def write_street(folder: Path, photos: int, *, seed: int = 0) -> None:
    """Write the photos, the exact cameras and `K.txt`; files that exist are kept."""
    images, reference = folder / "images", folder / "reference"
    for each in (images, reference):
        each.mkdir(parents=True, exist_ok=True)
    k = camera_matrix(SIZE)
    np.savetxt(folder / "K.txt", k, fmt="%.9g")
    planes = houses(STEP * photos, seed=seed)
    middles = np.asarray([plane.corner[0] + plane.right[0] / 2 for plane in planes])
    for number, pose in enumerate(walk(photos, seed=seed)):
        name = f"photo{number:05d}.png"
        (reference / f"{name}.camera").write_text(camera_text(k, pose, SIZE), encoding="ascii")
        if (images / name).exists():
            continue
        near = np.flatnonzero(np.abs(middles - pose.centre[0]) < 3 * HOUSE)
        write_photo(images / name, render([planes[i] for i in near], pose, SIZE))


def main(arguments: list[str] | None = None) -> None:
    """Write a street into a folder."""
    parser = argparse.ArgumentParser(prog="jaxsfm.bench.long_street", description=__doc__)
    parser.add_argument("folder", type=Path, help="where to write")
    parser.add_argument("--photos", type=int, default=1000, help="how many photos (default: 1000)")
    parser.add_argument("--seed", type=int, default=0, help="of the street (default: 0)")
    given = parser.parse_args(arguments)
    write_street(given.folder, given.photos, seed=given.seed)


if __name__ == "__main__":
    main()
