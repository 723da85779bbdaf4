"""How pixels of different sizes of one photo lie on each other.

A photo is worked on at several sizes: as it is stored (the original), at working size, and at
octaves of it. In all of them the centre of the top-left pixel is (0, 0), so coordinates are scaled
about the corner of that pixel, which is (-0.5, -0.5). COLMAP puts the corner at (0, 0) instead.
"""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Pixels:
    """The pixels of a reduced (or enlarged) image, measured in pixels of the original."""

    scale: tuple[float, float]
    """Original pixels per pixel of the image, (x, y)."""

    @classmethod
    def octave(cls, px: float) -> "Pixels":
        """The pixels of an octave: each covers px x px pixels of the image it was made of."""
        return cls((px, px))

    def from_original(self, xy: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the original, in pixels of the image."""
        return (xy + 0.5) / np.asarray(self.scale) - 0.5

    def to_original(self, xy: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the image, in pixels of the original."""
        return (xy + 0.5) * np.asarray(self.scale) - 0.5

    def from_colmap(self, xy: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the original as COLMAP counts its pixels, in pixels of the image."""
        return xy / np.asarray(self.scale) - 0.5

    def to_colmap(self, xy: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the image, in pixels of the original as COLMAP counts them."""
        return (xy + 0.5) * np.asarray(self.scale)

    def matrix(self) -> np.ndarray:
        """`to_original` as a float64 matrix (3, 3) on homogeneous points (x, y, 1)."""
        sx, sy = self.scale
        return np.asarray([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1.0]])
