"""Frames of a camera that slides over a flat picture, so that overlap is known exactly."""

import struct
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 320, 240


def picture(width: int, *, seed: int = 0) -> np.ndarray:
    """A picture with detail of all sizes, uint8 (HEIGHT, width, 3)."""
    rng = np.random.default_rng(seed)
    total = np.zeros((HEIGHT, width, 3))
    for cell in (4, 8, 16, 32):
        noise = rng.normal(0, 1, (HEIGHT // cell + 2, width // cell + 2, 3))
        total += cell**0.5 * cv2.resize(noise, (width, HEIGHT), interpolation=cv2.INTER_CUBIC)
    total = 128 + 45 * total / total.std()
    return np.clip(total, 0, 255).astype(np.uint8)


def views(places: Iterable[int], *, seed: int = 0) -> list[np.ndarray]:
    """The frames of a camera whose left border is at these pixels of a picture."""
    places = list(places)
    whole = picture(max(places) + WIDTH, seed=seed)
    return [np.ascontiguousarray(whole[:, x : x + WIDTH]) for x in places]


def blurred(frame: np.ndarray, pixels: int = 9) -> np.ndarray:
    """A frame that was taken while the camera turned sideways."""
    return cv2.blur(frame, (pixels, 1))


def write_video(path: Path, frames: list[np.ndarray], codec: str = "mp4v") -> Path:
    """Write frames as a video."""
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 30, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def ask_for_turn(path: Path, quarters: int) -> None:
    """Let an MP4 ask to be shown turned clockwise: the matrix in the box `tkhd` (ISO 14496-12)."""
    data = path.read_bytes()
    at = data.index(b"tkhd") + 4 + 40
    cos, sin = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarters % 4]
    one = 1 << 16
    matrix = [cos * one, sin * one, 0, -sin * one, cos * one, 0, 0, 0, 1 << 30]
    path.write_bytes(data[:at] + struct.pack(">9i", *matrix) + data[at + 36 :])
