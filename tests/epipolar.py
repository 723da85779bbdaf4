"""Two calibrated views with exact correspondences."""

import cv2
import numpy as np


def two_views(rng, n=60):
    """A fundamental matrix and exact correspondences, pixels."""
    k = np.asarray([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    rotation = cv2.Rodrigues(rng.normal(size=3) * 0.2)[0]
    t = rng.normal(size=3)
    cross = np.cross(np.eye(3), t / np.linalg.norm(t)).T
    f = np.linalg.inv(k).T @ cross @ rotation @ np.linalg.inv(k)
    points = rng.uniform([-2, -2, 4], [2, 2, 9], size=(n, 3))
    x0, x1 = points @ k.T, (points @ rotation.T + t) @ k.T
    return f, x0[:, :2] / x0[:, 2:], x1[:, :2] / x1[:, 2:]
