"""A rendered video whose camera's way is known, and what `jaxsfm frames` chooses of it.

`python -m jaxsfm.bench.rendered_video` renders the video, chooses frames and compares the overlap
of neighbours with the exact one. The camera walks along a street: first it stands still, then it
walks slowly, then fast, and at last it shakes, so that three of four frames are blurred. Results on
it must be called synthetic.
"""

import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.bench.synthetic import TexturedPlane, camera_matrix, mosaic, photo_textures, render
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.runs.video.frames import FrameOptions, frames_folder

SIZE = (480, 360)
DEPTH = 5.0
"""The distance of the wall, metres."""
PARTS = {"still": (40, 0.0), "slow": (60, 0.02), "fast": (20, 0.2), "shaken": (60, 0.06)}
"""The parts of the way: their numbers of frames, and metres from frame to frame."""
SHARP_EVERY = 4
"""Of the shaken frames, each fourth is sharp."""
EXPOSURES = 5
"""A blurred frame is the mean of so many pictures."""
SHAKE_DEG = 1.5
"""How far the camera turns while a blurred frame is taken: 12 pixels."""
JITTER_DEG = 0.05
"""The standard deviation of each frame's own small turn: half a pixel."""


class VideoFrame(NamedTuple):
    """A frame of the video."""

    part: str
    pose: CameraPose
    blurred: bool


def street() -> list[TexturedPlane]:
    """A wall of 20 m, the ground, and a board in front of the wall every three metres."""
    photos = photo_textures()
    v = lambda *xyz: np.asarray(xyz, float)  # noqa: E731
    planes = [
        TexturedPlane(
            corner=v(-4, -2.5, DEPTH),
            right=v(20, 0, 0),
            down=v(0, 4, 0),
            texture=mosaic(photos, 2, 10, tile=300),
        ),
        TexturedPlane(
            corner=v(-4, 1.5, DEPTH),
            right=v(20, 0, 0),
            down=v(0, 0, -4),
            texture=mosaic(photos[4:7], 2, 10, tile=300),
        ),
    ]
    for i in range(6):
        planes.append(
            TexturedPlane(
                corner=v(-2 + 3 * i, -0.2, DEPTH - 0.8),
                right=v(0.9, 0, 0.2),
                down=v(0, 1.2, 0),
                texture=mosaic(photos[i:] + photos[:i], 2, 2, tile=200),
            )
        )
    return planes


def turned(degrees: np.ndarray) -> np.ndarray:
    """A small turn, float64 (3, 3), from degrees about x, y and z."""
    return cv2.Rodrigues(np.radians(np.asarray(degrees, float)))[0]


def camera_way(*, seed: int = 0) -> list[VideoFrame]:
    """The frames of the video, in order."""
    rng = np.random.default_rng(seed)
    frames, x = [], 0.0
    for part, (count, metres) in PARTS.items():
        for i in range(count):
            x += metres
            rotation = turned(rng.normal(0, JITTER_DEG, 3))
            blurred = part == "shaken" and i % SHARP_EVERY != 0
            frames.append(VideoFrame(part, CameraPose(rotation, np.asarray([x, 0, 0])), blurred))
    return frames


def picture(planes: list[TexturedPlane], frame: VideoFrame) -> np.ndarray:
    """The pixels of a frame, uint8 RGB. Blur is the mean of pictures during a turn."""
    if not frame.blurred:
        return render(planes, frame.pose, SIZE)
    turns = np.linspace(-SHAKE_DEG / 2, SHAKE_DEG / 2, EXPOSURES)
    # The pictures of a real exposure are dense; a small blur closes the gaps between these.
    gap = SIZE[0] * np.radians(SHAKE_DEG) / (EXPOSURES - 1)
    pictures = [
        render(
            planes,
            CameraPose(turned(np.asarray([0, t, 0])) @ frame.pose.rotation, frame.pose.centre),
            SIZE,
        )
        for t in turns
    ]
    mean = np.mean(pictures, axis=0).astype(np.uint8)
    return cv2.blur(mean, (max(1, round(gap)), 1))


def seen_points(planes: list[TexturedPlane], pose: CameraPose, *, step: int = 8) -> np.ndarray:
    """The points of the scene at every `step`-th pixel of a view, float64 (n, 3)."""
    x, y = np.meshgrid(np.arange(0, SIZE[0], step), np.arange(0, SIZE[1], step))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    rays = rays @ np.linalg.inv(camera_matrix(SIZE)).T @ pose.rotation
    nearest = np.full(len(rays), np.inf)
    for plane in planes:
        normal = np.cross(plane.right, plane.down)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = ((plane.corner - pose.centre) @ normal) / (rays @ normal)
            offset = pose.centre + depth[:, None] * rays - plane.corner
            a = offset @ plane.right / (plane.right @ plane.right)
            b = offset @ plane.down / (plane.down @ plane.down)
        hit = (depth > 0) & (depth < nearest) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        nearest[hit] = depth[hit]
    there = np.isfinite(nearest)
    return pose.centre + nearest[there, None] * rays[there]


def exact_overlap(planes: list[TexturedPlane], first: CameraPose, second: CameraPose) -> float:
    """The part of a view whose points lie in the other view too: the lesser of both directions."""
    parts = []
    for here, there in ((first, second), (second, first)):
        points = seen_points(planes, here)
        x, y, depth = camera_matrix(SIZE) @ there.rotation @ (points - there.centre).T
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = x / depth, y / depth
        inside = (depth > 0) & (x >= 0) & (x < SIZE[0]) & (y >= 0) & (y < SIZE[1])
        parts.append(float(inside.mean()))
    return min(parts)


def write_video(path: Path, frames: list[VideoFrame], planes: list[TexturedPlane]) -> None:
    """Write the frames as an MPEG-4 video of 30 frames a second; OSError if OpenCV cannot."""
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), codec, 30, SIZE)
    if not writer.isOpened():
        raise OSError(f"{path}: OpenCV cannot write this video")
    for frame in frames:
        writer.write(cv2.cvtColor(picture(planes, frame), cv2.COLOR_RGB2BGR))
    writer.release()


def main(folder: Path) -> None:
    """Render the video into a folder unless it is there, and print what is chosen of it."""
    planes, frames = street(), camera_way()
    video = folder / "street.mp4"
    if not video.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_video(video, frames, planes)
    for overlap in (0.7, 0.8, 0.9):
        target = folder / f"frames-{overlap:g}"
        found = frames_folder(video, target, FrameOptions(overlap=overlap))
        numbers = [int(Path(name).stem.rpartition("-")[2]) for name in found.names]
        chosen = [frames[number] for number in numbers]
        exact = [
            exact_overlap(planes, a.pose, b.pose) for a, b in zip(chosen, chosen[1:], strict=False)
        ]
        by_part = {part: sum(f.part == part for f in chosen) for part in PARTS}
        print(
            f"--overlap {overlap:g}: {len(chosen)} of {len(frames)} frames {by_part}, "
            f"{sum(f.blurred for f in chosen)} blurred; exact overlap of neighbours: median "
            f"{np.median(exact):.3f}, {min(exact):.3f} to {max(exact):.3f}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp(prefix="jaxsfm-video-")))
