"""The geometry of 360-degree photos: equirectangular pixels, directions, and pinhole views.

An equirectangular photo, or *panorama*, is twice as wide as it is high. Its columns are equal steps
of the heading, and its rows are equal steps from straight up to straight down. Directions are those
of the panorama's own frame: x right, y down, z forward, through the middle of the picture. Pixels
are counted from the centre of the top-left one.

A *pinhole view* is what an ordinary camera would see from the place of the panorama. All views of a
panorama have one size and one focal length, and their common centre.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Direction(NamedTuple):
    """Where a view looks, in degrees: to the right of the middle of the panorama, and upwards."""

    heading: float
    pitch: float


@dataclasses.dataclass(frozen=True)
class ViewSet:
    """The pinhole views that a panorama is turned into."""

    directions: tuple[Direction, ...]
    fov_deg: float
    """The field of view of their width and of their height."""

    def __post_init__(self) -> None:
        if not 0 < self.fov_deg < 180:
            raise ValueError(f"fov_deg must lie between 0 and 180; got {self.fov_deg}")

    def focal(self, side: int) -> float:
        """The focal length of views of side x side pixels, pixels."""
        return side / 2 / np.tan(np.radians(self.fov_deg) / 2)

    def side(self, width: int, most: int) -> int:
        """The pixels of a side: as fine as a panorama of this width is along its equator, at the
        views' centres, where they are coarsest; at most `most`."""
        fine = width / (2 * np.pi) * 2 * np.tan(np.radians(self.fov_deg) / 2)
        return min(round(fine), most)

    def rotations(self) -> Float[np.ndarray, "views 3 3"]:
        """Of each view, the rotation from the panorama's frame into that of its camera."""
        return np.stack([_rotation(*np.radians(each)) for each in self.directions])

    def rays(
        self, side: int, *, samples: int = 1, rows: slice = slice(None)
    ) -> Float[np.ndarray, "rows columns 3"]:
        """The directions of the pixels of a view of side x side, in its camera's frame (z is 1).

        Args:
          samples: of each pixel and axis; there are side * samples rows and columns.
          rows: the rows of pixels that are wanted.
        """
        at = ((np.arange(side * samples) + 0.5) / samples - side / 2) / self.focal(side)
        x, y = np.meshgrid(at, at.reshape(side, samples)[rows].ravel())
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def seen_at(
        self, direction: Float[np.ndarray, "3"], side: int
    ) -> tuple[int, Float[np.ndarray, "2"]] | None:
        """The view of side x side that looks closest to a direction in the panorama's frame, and
        the pixel (x, y) at which it shows it; None if it does not."""
        rays = self.rotations() @ direction
        number = int(np.argmax(rays[:, 2]))
        x, y, z = rays[number]
        if z <= 0:
            return None
        at = self.focal(side) * np.asarray([x, y]) / z + side / 2 - 0.5
        return (number, at) if (np.abs(at - (side - 1) / 2) <= side / 2).all() else None


def _rotation(heading: float, pitch: float) -> Float[np.ndarray, "3 3"]:
    right = np.asarray([np.cos(heading), 0.0, -np.sin(heading)])
    forward = np.asarray(
        [np.cos(pitch) * np.sin(heading), -np.sin(pitch), np.cos(pitch) * np.cos(heading)]
    )
    return np.stack([right, np.cross(forward, right), forward])


def panorama_pixels(
    directions: Float[np.ndarray, "*n 3"], size: tuple[int, int]
) -> Float[np.ndarray, "*n 2"]:
    """Where a panorama of (width, height) shows directions of any length, pixels (x, y).

    x lies in -0.5 .. width - 0.5, and y in -0.5 .. height - 0.5.
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    heading, down = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
    turns = np.stack([heading / (2 * np.pi) + 0.5, down / np.pi + 0.5], axis=-1)
    return turns * np.asarray(size) - 0.5


def panorama_directions(
    xy: Float[np.ndarray, "*n 2"], size: tuple[int, int]
) -> Float[np.ndarray, "*n 3"]:
    """The unit directions of pixels (x, y) of a panorama of (width, height)."""
    turns = (xy + 0.5) / np.asarray(size) - 0.5
    heading, down = 2 * np.pi * turns[..., 0], np.pi * turns[..., 1]
    flat = np.cos(down)
    return np.stack([flat * np.sin(heading), np.sin(down), flat * np.cos(heading)], axis=-1)


def rows_per_pixel(height: int) -> Float[np.ndarray, " rows"]:
    """How many pixels of each row of a panorama are as wide as one of its equator: at least 1.

    Towards the poles, the same width of the world covers more and more pixels of a row.
    """
    down = (np.arange(height) + 0.5) / height - 0.5
    return 1 / np.cos(np.pi * down)
