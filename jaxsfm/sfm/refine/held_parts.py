"""Parts of a refined model that confirmed points hold together.

The refinement keeps only the observations that alignment confirms. What is left of a wrong model
are points of two views each, here and there: any two photos have such points, wherever the others
are. Where a third view stands, and how large a part is beside another, is told by points that three
views show.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxsfm.colmap.tracks import Tracks
from jaxsfm.sfm.refine.octave_pose import MIN_COUNT


def held_parts(tracks: Tracks, count: int) -> list[list[int]]:
    """Indices of the views of each part, the largest part first; the first view of equal ones.

    Two views are in one part if they share `MIN_COUNT` points that a third view shows, or if a
    chain of such views joins them. So much holds a view that is placed, and COLMAP's mapper asks
    for the same number to register an image. In right models of 17 sets of photos all views are
    one part, with 50 points as well, but for one view of *temple_sparse_ring*. A wrong model of
    that set falls into ten views and six single ones (docs/decisions/one-road.md).

    Args:
      count: the number of views.
    """
    use = tracks.num_observations()[tracks.point] >= 3
    at = (tracks.view[use], tracks.point[use])
    shape = (count, len(tracks.points))
    seen = coo_array((np.ones(len(at[0]), np.int32), at), shape=shape).tocsr()
    shared = (seen @ seen.T).tocsr()
    shared.data[shared.data < MIN_COUNT] = 0
    shared.eliminate_zeros()
    _, label = connected_components(shared, directed=False)
    parts = [np.flatnonzero(label == each).tolist() for each in range(label.max(initial=-1) + 1)]
    return sorted(parts, key=lambda part: (-len(part), part))
