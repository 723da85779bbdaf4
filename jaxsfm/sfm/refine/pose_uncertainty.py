"""How far off a pose is expected to be: the covariance of its least squares.

A hundred points in one corner of an image say less about its pose than fifty all over it.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsfm.colmap.view import View

STEP = 1e-6
"""Step of the numerical derivatives. Projections are float64."""
MEDIAN_RADIUS = 1.1774
"""Median length of a vector whose two coordinates are normal, in standard deviations."""
MAX_CONDITION = 1e12
"""Largest condition number of the normal equations of a pose. Good ones have 1e2 to 1e5."""
MAX_PROBES = 2000
"""Points at which the uncertainty of a pose is evaluated."""


def _jacobian(view: View, points: np.ndarray, *, focal: bool = False) -> np.ndarray:
    """Derivatives (n, 2, 6) of the pixels of points (n, 3) by the pose of a view.

    The pose is turned in the view's frame (radians), and its centre is moved in units of the
    points' distance. With `focal`, (n, 2, 7): the last column is for the relative focal length.
    """
    at, reach, columns = view.project(points)[0], _reach(view, points), []
    for k in range(6):
        step = STEP * np.eye(6)[k]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        moved = dataclasses.replace(
            view, rotation=turn @ view.rotation, centre=view.centre + reach * step[3:]
        )
        columns.append((moved.project(points)[0] - at) / STEP)
    if focal:
        principal = view.project(view.centre[None] + view.rotation[2])[0]
        columns.append(at - principal)
    return np.nan_to_num(np.stack(columns, axis=2))


def _reach(view: View, points: np.ndarray) -> float:
    """The median distance of points from the view."""
    return float(np.median(np.linalg.norm(points - view.centre, axis=1)))


def distinct_patches(xy: np.ndarray, side: float) -> int:
    """How many patches without overlap the observations (n, 2) amount to. Patches that overlap see
    the same photons, and so have the same errors.

    Args:
      side: side of a patch, pixels.
    """
    return len(np.unique(np.floor(xy / side), axis=0))


def _covariance(own: np.ndarray, xy: np.ndarray, error_px: float, side: float) -> np.ndarray | None:
    """Covariance of least squares over observations, or None if they determine no pose.

    Patches that overlap count as one.

    Args:
      own: Jacobian (n, 2, parameters) at the observations.
      xy: (n, 2), the observations.
      error_px: their median error.
      side: side of a patch, pixels.
    """
    variance = (error_px / MEDIAN_RADIUS) ** 2 * len(xy) / distinct_patches(xy, side)
    information = np.einsum("nia,nib->ab", own, own)
    if np.linalg.cond(information) > MAX_CONDITION:
        return None
    return variance * np.linalg.inv(information)


def projected_uncertainty(
    view: View,
    points: np.ndarray,
    xy: np.ndarray,
    shown: np.ndarray,
    error_px: float,
    side: float,
    *,
    focal: bool,
) -> float:
    """How far off the projections of what a view could show are expected to be.

    The covariance of the pose, and of the focal length, is carried over to those points.

    Args:
      points, xy: (n, 3) and (n, 2), the observations that determined the pose; pixels of the view.
      shown: (m, 3), the points that the view could show.
      error_px: median error of the observations.
      side: side of a patch, pixels.
      focal: the focal length was determined with the pose.

    Returns:
      root mean square along an axis, pixels; infinite if the observations determine no pose.
    """
    probes = shown[:: -(-len(shown) // MAX_PROBES)]
    columns = _jacobian(view, np.concatenate([points, probes]), focal=focal)
    own, others = np.split(columns, [len(points)])
    covariance = _covariance(own, xy, error_px, side)
    if covariance is None:
        return np.inf
    return float(np.sqrt(np.einsum("nia,ab,nib->n", others, covariance, others).mean() / 2))


class PoseUncertainty(NamedTuple):
    """How far off a pose is expected to be: root mean square, infinite if nothing determines it."""

    centre: float
    """Units of the model."""
    rotation_deg: float


def pose_uncertainty(
    view: View, points: np.ndarray, xy: np.ndarray, error_px: float, side: float, *, focal: bool
) -> PoseUncertainty:
    """The expected error of a pose. Errors of the model itself come on top.

    Args:
      points, xy, error_px, side, focal: as in `projected_uncertainty`.
    """
    covariance = _covariance(_jacobian(view, points, focal=focal), xy, error_px, side)
    if covariance is None:
        return PoseUncertainty(np.inf, np.inf)
    turn, shift = (float(np.sqrt(np.trace(covariance[k : k + 3, k : k + 3]))) for k in (0, 3))
    return PoseUncertainty(_reach(view, points) * shift, float(np.degrees(turn)))
