"""Parts of a graph of photos: each small enough to be adjusted alone, and overlapping the next.

A part that is too large is cut in two. Its photos are put in order of their distance from a photo
at its edge, where strong pairs are short ways, and the cut goes where the pairs across it are
weakest. All of this takes time in proportion to the number of pairs, times the logarithm of the
number of photos. Where parts are cut, each gets the photos of the other that have most matches with
it.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

SLACK = 0.25
"""A cut may lie so many sizes of a part beside the place where all parts would be equal, and a part
may be larger by twice as much."""
MOST_ADDED = 0.5
"""A part grows at most by this share by the photos of its neighbours."""


class Graph(NamedTuple):
    """Photos, and how strongly pairs of them belong together."""

    names: list[str]
    """Sorted."""
    weights: csr_array
    """float64 (n, n), symmetric: the number of matches of each pair."""


def overlapping_parts(graph: Graph, *, size: int, overlap: int) -> list[list[str]]:
    """Parts that cover all photos. The order of pairs and photos has no effect.

    Args:
      size: the number of photos of a part before its neighbours' photos are added. Parts may have
        half as many more.
      overlap: about so many photos are in two parts that were cut apart; half of them come from
        either side.

    Returns:
      the sorted names of each part, the parts in the order of their first names.

    Raises:
      ValueError: a number is too small.
    """
    if size < 2 or overlap < 0:
        raise ValueError(f"size must be at least 2 and overlap 0; got {size} and {overlap}")
    cores: list[np.ndarray] = []
    todo = [np.arange(len(graph.names))] if graph.names else []
    while todo:
        photos = todo.pop()
        inside = csr_array(graph.weights[photos][:, photos])
        count, label = connected_components(inside, directed=False)
        if count > 1:
            todo += [photos[label == k] for k in range(count)]
        elif len(photos) <= (1 + 2 * SLACK) * size:
            cores.append(photos)
        else:
            todo += [photos[side] for side in _halves(inside, size)]
    whole = [
        np.sort(np.r_[core, _beside(graph, cores, k, overlap)]) for k, core in enumerate(cores)
    ]
    return sorted([graph.names[i] for i in part] for part in whole)


def _halves(weights: csr_array, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The two sides of a cut through a connected graph, int, ascending. Each has about a whole
    number of times the size of a part."""
    lengths = csr_array((1 / weights.data, weights.indices, weights.indptr), shape=weights.shape)
    start = int(np.argmax(dijkstra(lengths, directed=False, indices=0)))
    order = np.argsort(dijkstra(lengths, directed=False, indices=start), kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    edges = weights.tocoo()
    first, last = np.sort([place[edges.row], place[edges.col]], axis=0)
    # Pair (first, last) is cut by every cut after `first` and not after `last`.
    change = np.bincount(first + 1, edges.data, len(order) + 1)
    change -= np.bincount(last + 1, edges.data, len(order) + 1)
    across = np.cumsum(change)
    parts = -(-len(order) // size)
    each = len(order) / parts
    low, high = (max(1, round(each * (parts // 2 + slack))) for slack in (-SLACK, SLACK))
    cut = low + int(np.argmin(across[low : min(high, len(order) - 1) + 1]))
    return np.sort(order[:cut]), np.sort(order[cut:])


def _beside(graph: Graph, cores: list[np.ndarray], part: int, overlap: int) -> np.ndarray:
    """The photos of other parts that are added to a part: of each neighbour half of the overlap, of
    the strongest neighbours first, at most `MOST_ADDED` of the part."""
    core = cores[part]
    matches = np.asarray(graph.weights[core].sum(axis=0)).ravel()
    found: list[tuple[float, np.ndarray]] = []
    for k, other in enumerate(cores):
        if k != part and (matches[other] > 0).any():
            best = _strongest(graph, matches, other, -(-overlap // 2))
            found.append((-float(matches[best].sum()), best))
    found.sort(key=lambda each: (each[0], each[1].tolist()))
    room = max(overlap, int(MOST_ADDED * len(core)))
    return np.concatenate([np.zeros(0, np.int64), *(best for _, best in found)])[:room]


def _strongest(graph: Graph, matches: np.ndarray, among: np.ndarray, count: int) -> np.ndarray:
    """The photos with most matches, each counted with those that were taken before it.

    Args:
      matches: float (n,), the matches of each photo with the part.
      among: only these photos are taken.
      count: at most so many.
    """
    matches = matches.copy()
    taken: list[int] = []
    while len(taken) < count:
        left = among[~np.isin(among, taken)]
        if not len(left) or matches[left].max() <= 0:
            break
        best = int(left[np.argmax(matches[left])])
        taken.append(best)
        row = slice(graph.weights.indptr[best], graph.weights.indptr[best + 1])
        matches[graph.weights.indices[row]] += graph.weights.data[row]
    return np.asarray(taken, np.int64)
