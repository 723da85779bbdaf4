"""Poses followed from octave to octave: a view of noise is aligned with the structure of other
views where noise averages out, at half, a quarter, an eighth of the working size.

A patch of 15 x 15 pixels of the third octave holds sixteen times the photons, and finds its place
from sixteen times as far. So the coarsest octave comes first, every octave starts from the pose of
the one before, and the pose that the evidence determines best stays.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.config import Refinement
from jaxsfm.host.model import Tracks, View
from jaxsfm.host.resection import adjust_view
from jaxsfm.track_alignment import ReadGray, align_blocks

MIN_COUNT = 30
"""Fewest points that must agree at an octave for its pose to count."""
MAX_SIGMA_PX = 1.0
"""Largest standard deviation of an observation, pixels of its octave; hundreds make the pose."""


class Observed(NamedTuple):
    """Points that one view shows, by alignment."""

    rows: np.ndarray
    """(n,): which points."""
    points: np.ndarray
    """float64 (n, 3)."""
    xy: np.ndarray
    """float64 (n, 2), pixels of the octave."""
    candidates: int
    """Points that it could have shown."""


class Pose(NamedTuple):
    """Where an octave puts a view."""

    view: View
    octave_px: int
    """Working pixels per pixel of the octave."""
    observed: Observed
    """In working pixels; those within the error limit."""
    agreed: int
    error_px: float
    """Median distance of where points agree from where the pose puts them, working pixels."""
    doubt: float
    """The same over the root of the number of distinct patches."""


@dataclasses.dataclass(kw_only=True)
class Followed:
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


def at_octave(
    octave_px: int, views: Sequence[View], tracks: Tracks, read: ReadGray
) -> tuple[list[View], Tracks, ReadGray]:
    """The same views, observations and images in pixels that are `octave_px` times as large."""

    def reduced(name: str) -> tuple[np.ndarray, tuple[float, float]]:
        gray, (sx, sy) = read(name)
        h, w = (side // octave_px for side in gray.shape)
        blocks = gray[: h * octave_px, : w * octave_px].reshape(h, octave_px, w, octave_px)
        return blocks.mean((1, 3)), (sx * octave_px, sy * octave_px)

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
    views: list[View], tracks: Tracks, read: ReadGray, targets: Sequence[int], config: Refinement
) -> list[Observed]:
    """Where each of the target views shows the points of `tracks`, which has no observations of
    them."""
    parts: list[list[Observed]] = [[] for _ in targets]
    gate = dataclasses.replace(config, min_score=config.weak_min_score, max_sigma_px=MAX_SIGMA_PX)
    for b in align_blocks(tracks, views, read, gate, config.max_shift_px, targets=targets):
        for k, part in zip(targets, parts, strict=True):
            own = b.found.view == k
            good = np.flatnonzero(own & b.agrees)
            at = b.found.point[good]
            part.append(Observed(b.rows[at], b.points[at], b.moved[good], int(own.sum())))
    return [
        Observed(
            np.concatenate([o.rows for o in part]),
            np.concatenate([o.points for o in part]),
            np.concatenate([o.xy for o in part]),
            sum(o.candidates for o in part),
        )
        for part in parts
    ]


def _distinct(xy: np.ndarray, side: int) -> int:
    """How many patches of `side` pixels the points lie in: patches that overlap see the same
    photons, and agree in their errors."""
    return len(np.unique(np.floor(xy / side), axis=0))


def _step(pose: Followed, view: View, seen: Observed, px: int, config: Refinement) -> None:
    """Move a pose to where an octave's points want it.

    Args:
      view: the pose's, in pixels of the octave.
    """
    pose.candidates, pose.agreed = seen.candidates, len(seen.rows)
    if pose.agreed < MIN_COUNT:
        return
    moved = adjust_view(view, seen.xy, seen.points, refine_focal_length=pose.own_camera)
    if moved is None:
        return
    pose.share = max(pose.share, pose.agreed / seen.candidates)
    pose.view = dataclasses.replace(moved, scale=pose.view.scale, size=pose.view.size)
    errors = np.linalg.norm(moved.project(seen.points)[0] - seen.xy, axis=1)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    error_px = float(np.median(errors)) * px
    doubt = error_px / np.sqrt(_distinct(seen.xy, 2 * config.radius + 1))
    if pose.best is None or doubt < pose.best.doubt:
        near = errors <= config.max_error_px
        xy = (seen.xy[near] + 0.5) * px - 0.5
        kept = Observed(seen.rows[near], seen.points[near], xy, seen.candidates)
        pose.best = Pose(pose.view, px, kept, pose.agreed, error_px, doubt)


def follow(
    poses: Sequence[Followed],
    views: Sequence[View],
    structure: Tracks,
    read: ReadGray,
    config: Refinement,
) -> None:
    """Follow all poses over all octaves, in place.

    Args:
      structure: points and their observations in `views`.
    """
    for octave in reversed(range(config.weak_octaves if poses else 0)):
        px = 2**octave
        every = [*views, *(pose.view for pose in poses)]
        smaller, tracks, reduced = at_octave(px, every, structure, read)
        targets = range(len(views), len(every))
        seen = _observe(smaller, tracks, reduced, targets, config)
        for k, pose, each in zip(targets, poses, seen, strict=True):
            _step(pose, smaller[k], each, px, config)
