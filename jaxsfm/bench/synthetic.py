"""Rendered scenes with exact cameras: photos of textured planes, and the folders of scenes.

A small room, seen from an arc and once at night, is the scene of `jaxsfm demo` and of the tests.
The textures are photographs from the scikit-image package. Results on rendered scenes must be
called synthetic.
"""

import dataclasses
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from jaxsfm.colmap.poses import CameraPose, Poses
from jaxsfm.io.atomic import atomic_folder
from jaxsfm.io.extras import extra

SUPERSAMPLING = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class TexturedPlane:
    """A rectangle of the points corner + s * right + t * down, with s and t in [0, 1]."""

    corner: np.ndarray
    right: np.ndarray
    down: np.ndarray
    texture: np.ndarray
    """uint8 (h, w, 3), RGB; the first row lies at the corner."""


def photo_textures() -> list[np.ndarray]:
    """Photographs from the scikit-image package, uint8 RGB."""
    with extra("demo", "the photographs of rendered scenes need"):
        import skimage.data as data
    photos = [data.astronaut(), data.coffee(), data.chelsea(), data.rocket(), data.brick()]
    photos += [data.gravel(), data.grass(), data.coins(), data.camera()]
    return [p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=2) for p in photos]


def mosaic(photos: list[np.ndarray], rows: int, cols: int, *, tile: int = 400) -> np.ndarray:
    """One texture of rows x cols photographs, uint8 RGB."""
    tiles = [cv2.resize(p, (tile, tile), interpolation=cv2.INTER_AREA) for p in photos]
    grid = [[tiles[(r * cols + c) % len(tiles)] for c in range(cols)] for r in range(rows)]
    return np.concatenate([np.concatenate(row, axis=1) for row in grid])


def room() -> list[TexturedPlane]:
    """Two walls, a floor and a slanted board, in metres; x right, y down, z forward."""
    a = photo_textures()
    v = lambda *xyz: np.asarray(xyz, float)  # noqa: E731
    return [
        TexturedPlane(
            corner=v(-3, -1.5, 5), right=v(4, 0, 1), down=v(0, 3, 0), texture=mosaic(a, 2, 3)
        ),
        TexturedPlane(
            corner=v(1, -1.5, 6), right=v(2.2, 0, -3), down=v(0, 3, 0), texture=mosaic(a[3:], 2, 2)
        ),
        TexturedPlane(
            corner=v(-3.5, 1.5, 6.5),
            right=v(7, 0, 0),
            down=v(0, 0, -5),
            texture=mosaic(a[4:7], 3, 4),
        ),
        TexturedPlane(
            corner=v(-0.9, 0, 4.2),
            right=v(1.3, 0, 0.4),
            down=v(0, 1.3, -0.3),
            texture=mosaic(a[7:] + a[:1], 2, 2),
        ),
    ]


def look_at(centre: np.ndarray, target: np.ndarray) -> CameraPose:
    """A camera at `centre` whose optical axis passes through `target`, upright (y down)."""
    z = target - centre
    z = z / np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return CameraPose(np.stack([x, np.cross(z, x), z]), np.asarray(centre, float))


def arc(num_views: int) -> list[CameraPose]:
    """Cameras on an arc of 40 degrees around the room's middle, at changing height."""
    target = np.asarray([-0.1, 0.1, 5.2])
    poses = []
    for i, angle in enumerate(np.radians(np.linspace(-20, 20, num_views))):
        # If the centres lay near one line, the rotation about this line would be uncertain.
        height = -1.0 + 0.6 * (i % 3)
        distance = 4.6 - 0.5 * (i % 2)
        centre = target + distance * np.asarray([np.sin(angle), 0, -np.cos(angle)])
        centre[1] += height
        poses.append(look_at(centre, target))
    return poses


def camera_matrix(size: tuple[int, int]) -> np.ndarray:
    """K of the demo's camera, float64 (3, 3); the centre of the top-left pixel is (0, 0)."""
    width, height = size
    return np.asarray([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1.0]])


def _in_view(plane: TexturedPlane, pose: CameraPose, k: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether a plane may be in the picture.

    It is not if its corners all lie outside one side of the pyramid of the camera's rays.
    """
    p = plane
    corners = np.stack(
        [p.corner, p.corner + p.right, p.corner + p.down, p.corner + p.right + p.down]
    )
    x, y, depth = k @ pose.rotation @ (corners - pose.centre).T
    # The photo's area ends half a pixel beyond the centres of its outer pixels.
    right, bottom = size[0] - 0.5, size[1] - 0.5
    inside = [depth, x + 0.5 * depth, right * depth - x, y + 0.5 * depth, bottom * depth - y]
    return all((side > 0).any() for side in inside)


def render(planes: list[TexturedPlane], pose: CameraPose, size: tuple[int, int]) -> np.ndarray:
    """An exact perspective image, uint8 RGB, averaged from an image of twice the resolution."""
    width, height = size
    k = camera_matrix(size)
    s = SUPERSAMPLING
    x = (np.arange(width * s) + 0.5) / s - 0.5
    y = (np.arange(height * s) + 0.5) / s - 0.5
    grid = np.stack([*np.meshgrid(x, y), np.ones((height * s, width * s))], axis=-1)
    rays = grid @ np.linalg.inv(k).T @ pose.rotation
    image = np.zeros((height * s, width * s, 3), np.uint8)
    nearest = np.full((height * s, width * s), np.inf)
    for plane in planes:
        if not _in_view(plane, pose, k, size):
            continue
        # centre + depth * ray = corner + a * right + b * down
        normal = np.cross(plane.right, plane.down)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = ((plane.corner - pose.centre) @ normal) / (rays @ normal)
            offset = pose.centre + depth[..., None] * rays - plane.corner
        a = offset @ plane.right / (plane.right @ plane.right)
        b = offset @ plane.down / (plane.down @ plane.down)
        hit = (depth > 0) & (depth < nearest) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        rows, cols = plane.texture.shape[:2]
        u = np.where(hit, a * cols - 0.5, 0).astype(np.float32)
        v = np.where(hit, b * rows - 0.5, 0).astype(np.float32)
        colour = cv2.remap(plane.texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        image[hit] = colour[hit]
        nearest[hit] = depth[hit]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def night(image: np.ndarray, *, seed: int) -> np.ndarray:
    """A simple synthetic night: dim bluish light, two warm lamps and photon noise."""
    rng = np.random.default_rng(seed)
    height, width = image.shape[:2]
    linear = (image / 255.0) ** 2.2
    y, x = np.mgrid[:height, :width]
    light = np.full((height, width, 3), 0.10) * [0.7, 0.85, 1.2]
    for cx, cy in ((0.3 * width, 0.3 * height), (0.75 * width, 0.55 * height)):
        falloff = 1 / (1 + ((x - cx) ** 2 + (y - cy) ** 2) / (0.22 * width) ** 2)
        light += 0.5 * falloff[..., None] * [1.2, 0.9, 0.55]
    electrons = rng.poisson(linear * light * 3000) + rng.normal(0, 4, image.shape)
    encoded = np.clip(electrons / 3000, 0, 1) ** (1 / 2.2)
    return np.round(255 * encoded).astype(np.uint8)


def camera_text(k: np.ndarray, pose: CameraPose, size: tuple[int, int]) -> str:
    """The content of a Strecha `.camera` file: K (3, 3), the pose, the width and the height."""
    rows = [*k, np.zeros(3), *pose.rotation.T, pose.centre]
    lines = [" ".join(f"{v:.9g}" for v in row) for row in rows]
    return "\n".join([*lines, f"{size[0]} {size[1]}"]) + "\n"


def write_photo(path: Path, rgb: np.ndarray) -> None:
    """Write an image, uint8 RGB, in the format of the file's suffix."""
    # OpenCV is not given the path: on Windows it cannot write every name.
    path.write_bytes(cv2.imencode(path.suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes())


def write_scene(
    folder: Path, *, num_views: int = 7, size: tuple[int, int] = (640, 480), seed: int = 0
) -> Poses:
    """Write images/, K.txt and reference/ (Strecha's format); returns the exact poses by name.

    The last view but one is at night.
    """
    images, reference = folder / "images", folder / "reference"
    images.mkdir(parents=True, exist_ok=True)
    reference.mkdir(parents=True, exist_ok=True)
    planes = room()
    k = camera_matrix(size)
    poses = {}
    for i, pose in enumerate(arc(num_views)):
        dark = i == num_views - 2
        name = f"view{i}_night.png" if dark else f"view{i}.png"
        rgb = render(planes, pose, size)
        if dark:
            rgb = night(rgb, seed=seed)
        write_photo(images / name, rgb)
        (reference / f"{name}.camera").write_text(camera_text(k, pose, size), encoding="ascii")
        poses[name] = pose
    np.savetxt(folder / "K.txt", k, fmt="%.9g")
    return poses


def check_scene(name: str, scenes: Collection[str]) -> None:
    """Raise ValueError unless there is a scene of this name."""
    if name not in scenes:
        raise ValueError(f"name must be one of {', '.join(scenes)}; got {name!r}")


def write_scene_folder(
    folder: Path, poses: Sequence[CameraPose], photos: Iterable[np.ndarray], size: tuple[int, int]
) -> None:
    """Write a scene in the layout of Strecha's sets: images/ with K.txt, and gt_dense_cameras/.

    The photos are called view00.png, view01.png and so on. The folder is written whole or not at
    all.

    Args:
      poses: in the order of the photos' names.
      photos: those of the poses, uint8 RGB; each is taken when it is written.
      size: width and height of the photos, pixels.
    """
    k = camera_matrix(size)
    # In these sets, pixels are counted from the corner of the top-left pixel, as COLMAP does.
    k[:2, 2] += 0.5
    with atomic_folder(folder) as fresh:
        images, cameras = fresh / "images", fresh / "gt_dense_cameras"
        images.mkdir()
        cameras.mkdir()
        np.savetxt(images / "K.txt", k, fmt="%.9g")
        for i, (pose, photo) in enumerate(zip(poses, photos, strict=True)):
            name = f"view{i:02d}.png"
            write_photo(images / name, photo)
            (cameras / f"{name}.camera").write_text(camera_text(k, pose, size), encoding="ascii")
