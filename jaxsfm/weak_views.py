"""Views in which refinement finds nothing to align, because photon noise hides it: a night among
days. They are placed on the structure that the other views make, at octaves where noise averages
out: half, a quarter, an eighth of the working size.

A patch of 15 x 15 pixels of the third octave holds sixteen times the photons, and finds its place
from sixteen times as far. So the coarsest octave comes first, every octave starts from the pose of
the one before, and the pose that the evidence determines best stays.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.config import Refinement
from jaxsfm.host.model import Sizes, Tracks, View, build_model, read_model_arrays
from jaxsfm.track_alignment import ReadGray, align_blocks

MIN_COUNT, MIN_SHARE = 30, 0.05
"""Fewest points that agree at an octave (in number, and of those that could be seen) for its pose
to count. At wrong poses 0.2 to 3 % agree by chance, at right ones 6 to 40 % (docs/design.md)."""

MAX_SIGMA_PX = 1.0
"""Largest standard deviation of an observation, pixels of its octave; hundreds make the pose."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Placed:
    """What became of a weak view."""

    name: str
    octave_px: int | None
    """Working pixels per pixel of the octave that gives the pose; None: no octave agrees, the view
    stays as it was."""
    candidates: int
    """Points of the other views that it could see, at that octave; at the last one if None."""
    agreed: int
    """Those that agree."""
    error_px: float | None
    """Median distance of where they agree from where the pose puts them, working pixels."""


class _Found(NamedTuple):
    """Points aligned to one view at one octave."""

    rows: np.ndarray
    """(n,): which points agree."""
    points: np.ndarray
    """float64 (n, 3)."""
    xy: np.ndarray
    """float64 (n, 2), pixels of the octave."""
    candidates: int


def _at_octave(
    octave_px: int, views: list[View], tracks: Tracks, read: ReadGray
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


def _find(
    views: list[View], tracks: Tracks, read: ReadGray, weak: list[int], config: Refinement
) -> dict[int, _Found]:
    """Where each weak view shows the points of `tracks`, which has no observations of it."""
    parts: dict[int, list[_Found]] = {k: [] for k in weak}
    gate = dataclasses.replace(config, min_score=config.weak_min_score, max_sigma_px=MAX_SIGMA_PX)
    for b in align_blocks(tracks, views, read, gate, config.max_shift_px, targets=weak):
        for k in weak:
            own = b.found.view == k
            good = np.flatnonzero(own & b.agrees)
            at = b.found.point[good]
            parts[k].append(_Found(b.rows[at], b.points[at], b.moved[good], int(own.sum())))
    return {
        k: _Found(
            np.concatenate([f.rows for f in found]),
            np.concatenate([f.points for f in found]),
            np.concatenate([f.xy for f in found]),
            sum(f.candidates for f in found),
        )
        for k, found in parts.items()
    }


def _resect(view: View, found: _Found, *, refine_focal: bool) -> View | None:
    """The view where its points want it: robust least squares from where it is."""
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.loss_function_scale = float(view.scale.mean())
    options.refine_focal_length = refine_focal
    camera = pycolmap.Camera(view.camera.todict())
    placed = pycolmap.refine_absolute_pose(
        view.cam_from_world(),
        (found.xy + 0.5) * view.scale,
        found.points,
        np.ones(len(found.rows), bool),
        camera,
        options,
    )
    if placed is None:
        return None
    pose = placed["cam_from_world"]
    rotation = pose.rotation.matrix()
    centre = -rotation.T @ pose.translation
    return dataclasses.replace(view, rotation=rotation, centre=centre, camera=camera)


def _distinct(xy: np.ndarray, side: int) -> int:
    """How many patches of `side` pixels the points lie in: patches that overlap see the same
    photons, and agree in their errors."""
    return len(np.unique(np.floor(xy / side), axis=0))


def _structure(tracks: Tracks, weak: list[int]) -> tuple[Tracks, np.ndarray]:
    """The points that at least two of the other views see, those observations, and which points
    they are."""
    strong = ~np.isin(tracks.view, weak)
    count = np.bincount(tracks.point[strong], minlength=len(tracks.points))
    rows = np.flatnonzero(count >= 2)
    place = np.full(len(tracks.points), -1)
    place[rows] = np.arange(len(rows))
    keep = np.flatnonzero(strong & (place[tracks.point] >= 0))
    return (
        Tracks(tracks.points[rows], place[tracks.point[keep]], tracks.view[keep], tracks.xy[keep]),
        rows,
    )


def place_weak_views(
    model: pycolmap.Reconstruction,
    weak: list[str],
    read: ReadGray,
    sizes: Sizes,
    *,
    config: Refinement,
    refine_intrinsics: bool,
) -> tuple[pycolmap.Reconstruction, list[Placed]]:
    """The model with its weak views placed on the structure of the others, which stays as it is.

    A placed view gets the observations that agree with its new pose instead of those it had.

    Args:
      model: not changed.
      weak: names of registered images.
      read, sizes: as in `refine_model`.
      refine_intrinsics: whether a weak view's focal length moves too, if the camera is its own.
    """
    views, tracks = read_model_arrays(model, sizes)
    index = [k for k, view in enumerate(views) if view.name in weak]
    structure, rows = _structure(tracks, index)
    users = np.unique([view.camera.camera_id for view in views], return_counts=True)
    shared = set(users[0][users[1] > 1])
    best: dict[int, tuple[float, View, _Found, Placed]] = {}
    last = {
        k: Placed(name=views[k].name, octave_px=None, candidates=0, agreed=0, error_px=None)
        for k in index
    }
    current = list(views)
    for octave in reversed(range(config.weak_octaves if len(rows) else 0)):
        px = 2**octave
        smaller, observed, reduced = _at_octave(px, current, structure, read)
        for k, found in _find(smaller, observed, reduced, index, config).items():
            last[k] = dataclasses.replace(
                last[k], candidates=found.candidates, agreed=len(found.rows)
            )
            if len(found.rows) < max(MIN_COUNT, MIN_SHARE * found.candidates):
                continue
            own = refine_intrinsics and views[k].camera.camera_id not in shared
            view = _resect(smaller[k], found, refine_focal=own)
            if view is None:
                continue
            errors = np.linalg.norm(view.project(found.points)[0] - found.xy, axis=1)
            error = float(np.median(np.nan_to_num(errors, nan=np.inf))) * px
            current[k] = dataclasses.replace(view, scale=views[k].scale, size=views[k].size)
            doubt = error / np.sqrt(_distinct(found.xy, 2 * config.radius + 1))
            if k in best and best[k][0] <= doubt:
                continue
            figures = dataclasses.replace(last[k], octave_px=px, error_px=error)
            near = errors <= config.max_error_px
            xy = (found.xy[near] + 0.5) * px - 0.5
            best[k] = doubt, current[k], found._replace(rows=rows[found.rows[near]], xy=xy), figures
    placed = [best[k][3] if k in best else last[k] for k in index]
    if not best:
        return model, placed
    stay = ~np.isin(tracks.view, list(best))
    point, view, xy = [tracks.point[stay]], [tracks.view[stay]], [tracks.xy[stay]]
    for k, (_, new, found, _) in best.items():
        views[k] = new
        point.append(found.rows)
        view.append(np.full(len(found.rows), k))
        xy.append(found.xy)
    joined = Tracks(tracks.points, *(np.concatenate(part) for part in (point, view, xy)))
    order = np.lexsort((joined.view, joined.point))
    return build_model(
        model, views, Tracks(joined.points, *(part[order] for part in joined[1:]))
    ), placed
