"""Whether a part of a model has shrunk.

The mapper joins the parts of a scene by the points that both show. Where these are few, the bundle
adjustment can shrink one part, cameras and points together. Its reprojection errors stay as they
are, and so do the rotations and directions of its pairs, so nothing in a photo contradicts it. But
its photos then see their points much nearer than other photos do.
"""

import numpy as np

from jaxsfm.colmap.model import Model

MOST_SPREAD = 100.0
"""Photos of one scene see their points at distances that differ by no more than this factor. True
models have factors of up to 15, and broken ones of 130 to 200 000
(docs/decisions/repeated-structure.md)."""
OUTER = 5.0
"""Per cent of the photos that are left out at either end, as single photos may be misplaced."""


def median_depths(model: Model) -> np.ndarray:
    """For each view the median depth of its points, float64 (views,), world units; NaN without."""
    points, of = model.tracks.points, model.tracks.point
    return np.asarray(
        [
            np.median((points[of[rows]] - view.centre) @ view.rotation[2]) if len(rows) else np.nan
            for view, rows in zip(model.views, model.rows, strict=True)
        ],
        np.float64,
    )


def shrunk(model: Model) -> list[str]:
    """The photos that see their points so much nearer than most that a part of the model has
    shrunk, sorted by name; none if all photos see them at similar distances."""
    depths = median_depths(model)
    ahead = depths > 0  # not NaN either
    if not ahead.any():
        return []
    nearest, farthest = np.percentile(depths[ahead], (OUTER, 100 - OUTER))
    if farthest <= MOST_SPREAD * nearest:
        return []
    near = ahead & (MOST_SPREAD * depths < farthest)
    return sorted(model.views[k].name for k in np.flatnonzero(near))
