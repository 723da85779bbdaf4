"""A similarity applied to a COLMAP model."""

import numpy as np
import pycolmap


def move_model(
    model: pycolmap.Reconstruction, scale: float, rotation: np.ndarray, translation: np.ndarray
) -> None:
    """Apply x -> scale * rotation @ x + translation to poses and points, in place.

    Args:
      rotation: float64 (3, 3).
      translation: float64 (3,).
    """
    turned = pycolmap.Rotation3d(np.ascontiguousarray(rotation))
    model.transform(pycolmap.Sim3d(scale, turned, translation))
