"""A model as it is shown: upright and without far points.

If there are reference poses, the model is in their units. A model that was moved into metres keeps
its directions.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.view import View
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.sfm.evaluation import Similarity

FAR = 0.5
"""How far a shown point may lie outside the box that holds the middle 98 % of the points, as a
share of the size of the box."""


class ShownCamera(NamedTuple):
    """A camera in the shown world."""

    name: str
    pose: CameraPose
    corners: np.ndarray
    """float64 (4, 3): the corners of the image at depth 1, relative to the centre of the camera,
    clockwise from the top left."""

    def frustum(self, depth: float) -> np.ndarray:
        """The points (10, 3) of one line along the edges of a pyramid whose base is at `depth`."""
        tip, at = self.pose.centre, self.pose.centre + depth * self.corners
        return np.stack([at[0], at[1], tip, at[2], at[3], tip, at[0], at[3], at[2], at[1]])


class Scene(NamedTuple):
    """The points and cameras that are shown. z is up, and the origin lies amid the cameras."""

    points: np.ndarray
    """float64 (n, 3)."""
    colours: np.ndarray
    """uint8 (n, 3)."""
    cameras: list[ShownCamera]
    reference: list[ShownCamera]
    """The reference poses; empty if there are none."""
    frustum_depth: float
    """The height of the pyramids that stand for cameras."""
    far: int
    """The number of points that are left out because they lie far from the others."""

    def behind(self) -> np.ndarray:
        """The direction (3,) from the model to the first viewpoint: behind and above cameras."""
        ahead = np.mean([c.pose.rotation[2] for c in self.cameras], axis=0)
        ahead[2] = 0.0
        length = np.linalg.norm(ahead)
        ahead = ahead / length if length > 0.1 else np.asarray([0.0, 1.0, 0.0])
        return np.asarray([0.0, 0.0, 0.4]) - 0.9 * ahead


def _corners(view: View) -> np.ndarray:
    """The corners float64 (4, 3) of a view's image at depth 1, in the frame of the camera."""
    w, h = view.size
    xy = np.asarray([[0, 0], [w, 0], [w, h], [0, h]], float) - 0.5
    return view.rays(xy) @ view.rotation.T


def _upright(poses: list[CameraPose]) -> np.ndarray:
    """The rotation (3, 3) that turns the mean upward direction of the cameras to z."""
    down = np.mean([pose.rotation[1] for pose in poses], axis=0)
    if np.linalg.norm(down) < 0.1:  # the cameras are turned in all directions: take the first
        down = poses[0].rotation[1]
    up = -down / np.linalg.norm(down)
    right = np.mean([pose.rotation[0] for pose in poses], axis=0)
    right -= (right @ up) * up
    if np.linalg.norm(right) < 1e-3:
        right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _depth(centres: np.ndarray, extent: float) -> float:
    """The depth of a frustum with which cameras neither touch each other nor vanish."""
    nearest = extent
    if len(centres) > 1:
        nearest = float(np.median(KDTree(centres).query(centres, k=2)[0][:, 1]))
    return float(np.clip(0.5 * nearest, 0.01 * extent, 0.08 * extent))


def shown_scene(run: FinishedRun) -> Scene:
    """The best model of a run; ValueError if it has none."""
    if run.model is None:
        raise ValueError("run must have a model; got none")
    model = run.model
    own = Similarity(1.0, np.eye(3), np.zeros(3))
    to_reference = run.reference.similarity if run.reference else own
    poses = [to_reference.moved(view.pose) for view in model.views]
    # The float32 of a browser has too few digits for geographic coordinates: move to the origin.
    known = run.report.in_metres and run.reference is None
    upright = np.eye(3) if known else _upright(poses)
    turn = Similarity(1.0, upright, -upright @ np.mean([p.centre for p in poses], axis=0))
    corners = [_corners(view) for view in model.views]

    def camera(name: str, pose: CameraPose, at: np.ndarray) -> ShownCamera:
        turned = turn.moved(pose)
        return ShownCamera(name, turned, at @ turned.rotation)

    cameras = [
        camera(view.name, pose, at)
        for view, pose, at in zip(model.views, poses, corners, strict=True)
    ]
    usual = np.median(corners, axis=0)
    reference = [
        camera(name, pose, usual)
        for name, pose in sorted(run.reference.poses.items() if run.reference else ())
    ]
    points = to_reference.scale * model.tracks.points @ to_reference.rotation.T
    points = (points + to_reference.translation) @ turn.rotation.T + turn.translation
    centres = np.asarray([c.pose.centre for c in cameras])
    low, high = np.percentile(np.concatenate([points, centres]), (1, 99), axis=0)
    low, high = np.minimum(low, centres.min(0)), np.maximum(high, centres.max(0))
    margin = FAR * (high - low)
    near = ((points >= low - margin) & (points <= high + margin)).all(1)
    return Scene(
        points=points[near],
        colours=run.colours[near],
        cameras=cameras,
        reference=reference,
        frustum_depth=_depth(centres, float(np.linalg.norm(high - low))),
        far=int((~near).sum()),
    )
