"""How many points of a model are tested, so that the time of a check does not grow with the density
of photos."""

import numpy as np

from jaxsfm.colmap.model import Model

POINTS_PER_VIEW, MAX_POINTS = 1000, 100_000
"""At most so many points of a model are tested, per view and in all. Each is seen by several views,
so every view has more than these to show."""
OBSERVED_PER_VIEW = 2500
"""Points are tested until each view observes so many, on average. In a video each point is seen by
many views: with 1000 points per view, the check of 50 frames of kitchen took a third longer than
COLMAP's verification of their pairs (63 and 47 s), and with this limit a tenth less."""
TRIED_PER_VIEW, TRIED_POINTS = 4000, 2000
"""Points are tested until each view has so many to try, on average, whether it observes them or
not. The average is that of so many points. In a video many views may show a point."""
FACING = 0.25
"""Views that see a point from the side of those that observe it: the least cosine of the angle
between their directions, as between a view and a surface (`Refinement.min_cosine`)."""


def thinned(model: Model, *, per_view: int = POINTS_PER_VIEW) -> Model:
    """The model with at most `per_view` points per view and `MAX_POINTS` in all, and with at most
    `OBSERVED_PER_VIEW` observations and `TRIED_PER_VIEW` points to try per view, on average.

    They are taken evenly by index.
    """
    rows = thinned_points(model, per_view=per_view)
    if len(rows) == len(model.tracks.points):
        return model
    return model.with_tracks(model.tracks.select_points(rows))


def thinned_points(model: Model, *, per_view: int = POINTS_PER_VIEW) -> np.ndarray:
    """The points that `thinned` takes, int, ascending."""
    count, views = len(model.tracks.points), len(model.views)
    observed = max(len(model.tracks.point), 1)
    enough = OBSERVED_PER_VIEW * views * count // observed
    most = min(per_view * views, MAX_POINTS, enough)
    if min(count, most) > TRIED_PER_VIEW:  # fewer points cannot be too many in any view
        most = min(most, int(TRIED_PER_VIEW * views / max(_views_of_a_point(model), 1.0)))
    return _evenly(count, most)


def _evenly(count: int, most: int) -> np.ndarray:
    """At most so many indices below `count`, int, ascending."""
    return np.arange(count) if count <= most else np.arange(most) * count // most


def _views_of_a_point(model: Model) -> float:
    """How many views may show a point on average: it lies inside of them, and they see it from the
    side from which it is observed."""
    few = model.tracks.select_points(_evenly(len(model.tracks.points), TRIED_POINTS))
    centres = np.asarray([view.centre for view in model.views])
    side = np.zeros((len(few.points), 3))
    np.add.at(side, few.point, _unit(centres[few.view] - few.points[few.point]))
    shown, side = 0, _unit(side)
    for view in model.views:
        xy, _ = view.project(few.points)
        facing = (_unit(view.centre - few.points) * side).sum(1) > FACING
        with np.errstate(invalid="ignore"):  # NaN behind the camera
            inside = ((xy > -0.5) & (xy < np.asarray(view.size) - 0.5)).all(1)
        shown += int((inside & facing).sum())
    return shown / max(len(few.points), 1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of unit length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
