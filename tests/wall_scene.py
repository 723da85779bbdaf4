"""Rendered walls with exact cameras, points and pixels, as models: posters, repeats and matches."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from room_scene import SIZE, hidden, view_of

from jaxsfm.bench.synthetic import TexturedPlane, look_at, render
from jaxsfm.bench.walls import TEXELS, collage, moved, wall
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.core.types import Status
from jaxsfm.io.images import WorkingImage
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.io.photos import intensities
from jaxsfm.sfm.evaluation import Similarity
from jaxsfm.sfm.refine.device_images import DeviceImages

REFINEMENT = Refinement()
WIDTH, HEIGHT, DISTANCE = 4.0, 3.0, 4.0
"""Of the wall, and of the cameras from it, metres."""
POINTS = 400
"""On the wall."""


class Scene(NamedTuple):
    """A model, its photos, and on which plane each of its points lies."""

    model: Model
    photos: dict[str, np.ndarray]
    """float32 (h, w), by name."""
    plane: np.ndarray
    """int (points,)."""

    @property
    def images(self) -> DeviceImages:
        return DeviceImages(lambda name: (self.photos[name], (1.0, 1.0)))

    @property
    def names(self) -> list[str]:
        return [view.name for view in self.model.views]


@functools.cache
def picture(
    seed: int, *, left: float, width: float, height: float, z: float = 0.0
) -> TexturedPlane:
    """An upright rectangle with a texture of its own; the cameras stand at smaller z."""
    return wall(left, width, z, collage(seed, (round(width * TEXELS), round(height * TEXELS))))


def big_wall(seed: int = 0) -> TexturedPlane:
    """A wall that fills every photo."""
    return picture(seed, left=-1.5 * WIDTH, width=3 * WIDTH, height=3 * HEIGHT)


def poster(seed: int) -> TexturedPlane:
    """A rectangle on the wall; all posters hang in the same place."""
    return picture(seed, left=-0.6, width=1.2, height=1.2, z=-0.002)


def cameras(
    angles_deg: Sequence[float],
    *,
    distance: float = DISTANCE,
    motion: Similarity | None = None,
) -> list[CameraPose]:
    """Cameras that look at the middle of the wall, or of the wall after a motion."""
    poses = []
    for k, angle in enumerate(np.radians(angles_deg)):
        centre = distance * np.asarray([np.sin(angle), 0.1 * (k % 3 - 1), -np.cos(angle)])
        pose = look_at(centre, np.zeros(3))
        if motion is not None:
            turned = pose.rotation @ motion.rotation.T
            pose = CameraPose(turned, motion.rotation @ pose.centre + motion.translation)
        poses.append(pose)
    return poses


def on_plane(plane: TexturedPlane, count: int, seed: int) -> np.ndarray:
    """Points of the middle of a wall, or of all of a smaller rectangle."""
    rng = np.random.default_rng([seed, count])
    wide, high = np.linalg.norm(plane.right), np.linalg.norm(plane.down)
    share = np.minimum(0.47, [0.5 * WIDTH / wide, 0.5 * HEIGHT / high])
    st = 0.5 + rng.uniform(-1, 1, (count, 2)) * share
    return plane.corner + st[:, :1] * plane.right + st[:, 1:] * plane.down


def scene(seen_by: Sequence[tuple[Sequence[TexturedPlane], Sequence[CameraPose]]]) -> Scene:
    """A model of what groups of cameras see: of each group, its planes and its cameras.

    A group may have other planes in the same place: then the model takes two places for one. Points
    belong to planes. What is covered by another plane has no point. Every point is seen by two
    views or more.
    """
    planes: list[TexturedPlane] = []
    for some, _ in seen_by:
        planes += [plane for plane in some if not any(plane is known for known in planes)]
    areas = [np.linalg.norm(p.right) * np.linalg.norm(p.down) for p in planes]
    counts = [round(POINTS * min(1.0, area / (WIDTH * HEIGHT))) for area in areas]
    points = np.concatenate(
        [on_plane(p, n, k) for k, (p, n) in enumerate(zip(planes, counts, strict=True))]
    )
    plane = np.repeat(np.arange(len(planes)), counts)
    views: list[View] = []
    photos: dict[str, np.ndarray] = {}
    shown = []
    for some, poses in seen_by:
        own = [k for k, p in enumerate(planes) if any(p is one for one in some)]
        where = np.asarray([own.index(k) if k in own else -1 for k in plane.tolist()])
        for pose in poses:
            view = view_of(pose, len(views))
            views.append(view)
            photos[view.name] = intensities(
                WorkingImage(render(list(some), pose, SIZE), (1.0, 1.0))
            )
            xy, _ = view.project(points)
            with np.errstate(invalid="ignore"):
                inside = (xy > 9).all(1) & (xy < np.asarray(SIZE) - 10).all(1)
            covered = hidden(points, where, view.centre, [planes[k] for k in own])
            # `hidden` takes a plane 1 % nearer for the same one: posters hang flat on the wall.
            for k in own:
                if np.linalg.norm(planes[k].right) < 0.5 * WIDTH:
                    covered |= (where != own.index(k)) & _behind(points, view.centre, planes[k])
            shown.append((where >= 0) & inside & ~covered)
    visible = np.stack(shown, axis=1)
    visible &= (visible.sum(1) >= 2)[:, None]
    point, view = np.nonzero(visible)
    xy = np.empty((len(point), 2))
    for k, each in enumerate(views):
        xy[view == k] = each.project(points[point[view == k]])[0]
    rows = np.flatnonzero(visible.any(1))
    tracks = Tracks(points, point, view, xy).select_points(rows)
    return Scene(Model(views, tracks), photos, plane[rows])


def _behind(points: np.ndarray, centre: np.ndarray, plane: TexturedPlane) -> np.ndarray:
    """Whether a plane lies between a camera and each point, or very near the ray."""
    ray = points - centre
    normal = np.cross(plane.right, plane.down)
    depth = ((plane.corner - centre) @ normal) / (ray @ normal)
    offset = centre + depth[:, None] * ray - plane.corner
    a = offset @ plane.right / (plane.right @ plane.right)
    b = offset @ plane.down / (plane.down @ plane.down)
    return (np.abs(a - 0.5) < 0.53) & (np.abs(b - 0.5) < 0.53) & (depth > 0) & (depth < 0.9999)


def matched(pair: Pair, keypoints0: np.ndarray, keypoints1: np.ndarray) -> PairResult:
    """The matches of a pair, original pixels; the names may be in any order."""
    right = make_pair(*pair)
    sides = (keypoints0, keypoints1) if right == pair else (keypoints1, keypoints0)
    n = len(keypoints0)
    return PairResult(
        pair=right,
        cells=np.zeros((n, 2), np.int32),
        keypoints0=sides[0].astype(np.float32),
        keypoints1=sides[1].astype(np.float32),
        plane=np.zeros(n, np.int32),
        homographies=np.eye(3)[None],
        num_tentative=n,
        num_dropped=0,
        status=Status.VERIFIED,
    )


def true_matches(model: Model, a: int, b: int, *, most: int | None = None) -> PairResult:
    """The points that two views both observe."""
    one, other = (
        dict(zip(model.tracks.point[own], model.tracks.xy[own], strict=True))
        for own in (model.tracks.view == a, model.tracks.view == b)
    )
    both = sorted(one.keys() & other.keys())[:most]
    sides = [np.asarray([each[k] for k in both]).reshape(-1, 2) for each in (one, other)]
    return matched((model.views[a].name, model.views[b].name), *sides)


def twin_matches(model: Model, a: int, b: int, motion: Similarity) -> PairResult:
    """A false pair: points that view a observes, and where view b shows them after a motion."""
    own = np.flatnonzero(model.tracks.view == a)
    twins = model.tracks.points[model.tracks.point[own]] @ motion.rotation.T + motion.translation
    at, _ = model.views[b].project(twins)
    with np.errstate(invalid="ignore"):
        seen = (at > 0).all(1) & (at < np.asarray(SIZE) - 1).all(1)
    names = (model.views[a].name, model.views[b].name)
    return matched(names, model.tracks.xy[own][seen], at[seen])


def repeated(plane: TexturedPlane, motion: Similarity) -> TexturedPlane:
    """The same wall in another place."""
    return moved(plane, motion)
