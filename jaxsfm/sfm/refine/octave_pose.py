"""Poses followed from octave to octave: a view of noise is aligned with the structure of other
views where noise averages out, at half, a quarter, an eighth of the working size.

A patch of 15 x 15 pixels of the third octave holds sixteen times the photons, and finds its place
from sixteen times as far. So the coarsest octave comes first, every octave starts from the pose of
the one before until it stands still, and the pose that the evidence determines best stays.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsfm.colmap.model import Tracks, View
from jaxsfm.colmap.resection import adjust_view
from jaxsfm.config import Refinement
from jaxsfm.io.photos import Reader
from jaxsfm.sfm.refine.padding import block_means
from jaxsfm.sfm.refine.track_alignment import align_blocks

MIN_COUNT = 30
"""Fewest points that must agree at an octave for its pose to count."""
MIN_SHARE = 0.05
"""Least share of the points it could see that an image must agree with, at one octave at least. At
wrong poses up to 7 % agree, at right ones 8 to 70 % at an eighth of the size (docs/design.md)."""
MAX_DOUBT_PX = 1.0
"""Of a trusted pose, working pixels; of right ones 0.2 to 0.7. Of 24 followed from wrong starts
(castle-P19 0016) one ends at 0.95, where 1.5 % agree, the others above 1.6 or without any."""
MAX_DESCENTS, SURE_PX = 2, 0.5
"""A pose that ends in more doubt, working pixels, is followed over all octaves once more, from
where it was best: one that came home only at the last octave finds more at the first (castle-P19
night 0008: 1.84 m, 0.43 after one descent, 0.07 after two)."""
MAX_STEPS, STILL_PX = 4, 0.5
"""An octave's steps end when the median point moves by less, pixels of the octave. From 6.5 m
off, 8 % of what a view could see agreed at the first step, 15 % at the second."""
STEP = 1e-6
"""Of numerical derivatives; projections are float64."""
MEDIAN_RADIUS = 1.1774
"""Median length of a vector whose two coordinates are normal, in standard deviations."""
MAX_CONDITION = 1e12
"""Of a pose's normal equations; of good ones 1e2 to 1e5."""
MAX_PROBES = 2000
"""Points at which a pose's doubt is looked at."""
MAX_SIGMA_PX = 1.0
"""Largest standard deviation of an observation, pixels of its octave; hundreds make the pose."""


class AlignedPoints(NamedTuple):
    """Points that one view shows, by alignment."""

    rows: np.ndarray
    """(n,): which points."""
    points: np.ndarray
    """float64 (n, 3)."""
    xy: np.ndarray
    """float64 (n, 2), pixels of the octave."""
    could: np.ndarray
    """float64 (m, 3): all points that it could have shown."""


class Pose(NamedTuple):
    """Where an octave puts a view."""

    view: View
    octave_px: int
    """Working pixels per pixel of the octave."""
    observed: AlignedPoints
    """In working pixels; those within the error limit."""
    agreed: int
    error_px: float
    """Median distance of where points agree from where the pose puts them, working pixels."""
    doubt_px: float
    """How far off the view's projections of what it could show are expected to be, working pixels
    (`_doubt`)."""


@dataclasses.dataclass(kw_only=True)
class PoseHypothesis:
    """A pose that is followed from octave to octave."""

    view: View
    """Where the last octave put it, in working pixels."""
    own_camera: bool
    """Its focal length may change."""
    best: Pose | None = None
    """Of the octaves, the one of least doubt."""
    candidates: int = 0
    agreed: int = 0
    """At the last octave."""
    share: float = 0.0
    """Largest share of the candidates that agreed at an octave."""


def trusted(pose: PoseHypothesis) -> Pose | None:
    """The best octave's pose, if the evidence is enough for it."""
    best = pose.best
    enough = best is not None and pose.share >= MIN_SHARE and best.doubt_px <= MAX_DOUBT_PX
    return best if enough else None


def at_octave(
    octave_px: int, views: Sequence[View], tracks: Tracks, read: Reader
) -> tuple[list[View], Tracks, Reader]:
    """The same views, observations and images in pixels that are `octave_px` times as large."""

    def reduced(name: str) -> tuple[np.ndarray, tuple[float, float]]:
        gray, (sx, sy) = read(name)
        return block_means(gray, octave_px), (sx * octave_px, sy * octave_px)

    smaller = [
        dataclasses.replace(
            view,
            scale=view.scale * octave_px,
            size=(view.size[0] // octave_px, view.size[1] // octave_px),
        )
        for view in views
    ]
    return smaller, tracks._replace(xy=(tracks.xy + 0.5) / octave_px - 0.5), reduced


def _observe(
    views: list[View], tracks: Tracks, read: Reader, targets: Sequence[int], config: Refinement
) -> list[AlignedPoints]:
    """Where each of the target views shows the points of `tracks`, which has no observations of
    them."""
    nothing = AlignedPoints(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 3)))
    parts = [[nothing] for _ in targets]
    gate = dataclasses.replace(config, min_score=config.weak_min_score, max_sigma_px=MAX_SIGMA_PX)
    for b in align_blocks(tracks, views, read, gate, config.max_shift_px, targets=targets):
        for k, part in zip(targets, parts, strict=True):
            own = b.found.view == k
            good = np.flatnonzero(own & b.agrees)
            at = b.found.point[good]
            could = b.points[b.found.point[own]]
            part.append(AlignedPoints(b.rows[at], b.points[at], b.moved[good], could))
    return [
        AlignedPoints(
            np.concatenate([o.rows for o in part]),
            np.concatenate([o.points for o in part]),
            np.concatenate([o.xy for o in part]),
            np.concatenate([o.could for o in part]),
        )
        for part in parts
    ]


def _jacobian(view: View, points: np.ndarray, *, focal: bool = False) -> np.ndarray:
    """Change (n, 2, 6) of the pixels of points with the view's rotation (radians, in its frame) and
    centre (in units of the points' distance); (n, 2, 7) with that by the focal length, relative."""
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
    """How far off points are: the median distance."""
    return float(np.median(np.linalg.norm(points - view.centre, axis=1)))


def _covariance(own: np.ndarray, xy: np.ndarray, error_px: float, side: float) -> np.ndarray | None:
    """Of least squares over observations (n, 2); None if they determine no pose. Patches that
    overlap see the same photons and agree in their errors: one counts.

    Args:
      own: their Jacobian (n, 2, parameters).
      error_px: their median error.
      side: of a patch.
    """
    distinct = len(np.unique(np.floor(xy / side), axis=0))
    variance = (error_px / MEDIAN_RADIUS) ** 2 * len(xy) / distinct
    information = np.einsum("nia,nib->ab", own, own)
    if np.linalg.cond(information) > MAX_CONDITION:
        return None
    return variance * np.linalg.inv(information)


def _doubt(view: View, seen: AlignedPoints, error_px: float, side: int) -> float:
    """How far off the projections of what a view could show are expected to be, root mean square
    along an axis, pixels: the covariance of least squares, carried over to those points.

    So a hundred points in one corner say less about a pose than fifty everywhere.

    Args:
      error_px: median error of `seen`.
      side: of a patch.
    """
    probes = seen.could[:: -(-len(seen.could) // MAX_PROBES)]
    columns = _jacobian(view, np.concatenate([seen.points, probes]))
    own, others = np.split(columns, [len(seen.points)])
    covariance = _covariance(own, seen.xy, error_px, side)
    if covariance is None:
        return np.inf
    return float(np.sqrt(np.einsum("nia,ab,nib->n", others, covariance, others).mean() / 2))


class PoseDoubt(NamedTuple):
    """How far off a pose is expected to be, root mean square; infinite if nothing determines it."""

    centre: float
    """Units of the model."""
    rotation_deg: float


def pose_doubt(
    view: View, points: np.ndarray, xy: np.ndarray, error_px: float, side: float, *, focal: bool
) -> PoseDoubt:
    """The same covariance, of the pose itself. The model's own error comes on top.

    Args:
      points, xy: what determined it, (n, 3) and (n, 2) in the view's pixels.
      error_px, side: as in `_covariance`.
      focal: the focal length was determined with it.
    """
    covariance = _covariance(_jacobian(view, points, focal=focal), xy, error_px, side)
    if covariance is None:
        return PoseDoubt(np.inf, np.inf)
    turn, shift = (float(np.sqrt(np.trace(covariance[k : k + 3, k : k + 3]))) for k in (0, 3))
    return PoseDoubt(_reach(view, points) * shift, float(np.degrees(turn)))


def _step(
    pose: PoseHypothesis, view: View, seen: AlignedPoints, px: int, config: Refinement
) -> bool:
    """Move a pose to where an octave's points want it; whether that is far.

    Args:
      view: the pose's, in pixels of the octave.
    """
    pose.candidates, pose.agreed = len(seen.could), len(seen.rows)
    if pose.agreed < MIN_COUNT:
        return False
    moved = adjust_view(view, seen.xy, seen.points, refine_focal_length=pose.own_camera)
    if moved is None:
        return False
    pose.share = max(pose.share, pose.agreed / len(seen.could))
    pose.view = dataclasses.replace(moved, scale=pose.view.scale, size=pose.view.size)
    errors = np.linalg.norm(moved.project(seen.points)[0] - seen.xy, axis=1)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    error_px = float(np.median(errors))
    doubt_px = _doubt(moved, seen, error_px, 2 * config.radius + 1) * px
    if pose.best is None or doubt_px < pose.best.doubt_px:
        near = errors <= config.max_error_px
        xy = (seen.xy[near] + 0.5) * px - 0.5
        kept = AlignedPoints(seen.rows[near], seen.points[near], xy, seen.could)
        pose.best = Pose(pose.view, px, kept, pose.agreed, error_px * px, doubt_px)
    way = moved.project(seen.points)[0] - view.project(seen.points)[0]
    return bool(np.median(np.linalg.norm(way, axis=1)) > STILL_PX)


def follow(
    poses: Sequence[PoseHypothesis],
    views: Sequence[View],
    structure: Tracks,
    read: Reader,
    config: Refinement,
) -> None:
    """Follow all poses over all octaves, in place; those that end in doubt once more.

    Args:
      structure: points and their observations in `views`.
    """
    unsure = poses
    for _ in range(MAX_DESCENTS):
        if not unsure:
            break
        for pose in unsure:
            pose.view = pose.best.view if pose.best else pose.view
        _descend(unsure, views, structure, read, config)
        unsure = [pose for pose in unsure if pose.best and pose.best.doubt_px > SURE_PX]


def _descend(
    poses: Sequence[PoseHypothesis],
    views: Sequence[View],
    structure: Tracks,
    read: Reader,
    config: Refinement,
) -> None:
    """From the coarsest octave to the finest, in place; at each until it stands still."""
    for octave in reversed(range(config.weak_octaves)):
        px, moving = 2**octave, list(poses)
        for _ in range(MAX_STEPS):
            if not moving:
                break
            every = [*views, *(pose.view for pose in moving)]
            smaller, tracks, reduced = at_octave(px, every, structure, read)
            targets = range(len(views), len(every))
            seen = _observe(smaller, tracks, reduced, targets, config)
            far = [
                _step(pose, smaller[k], each, px, config)
                for k, pose, each in zip(targets, moving, seen, strict=True)
            ]
            moving = [pose for pose, more in zip(moving, far, strict=True) if more]
