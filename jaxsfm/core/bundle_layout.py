"""Which rows of a bundle adjustment belong together. It is known before any program runs, so lists
of them are made once, with numpy.

A row is one keypoint of one photo and one point. A photo depends on f numbers: a rotation vector, a
translation, and those parameters of its camera that move. All photos and cameras together have z
numbers. The blocks of photos have d of the f numbers: all, or only the six of the pose. Then the
numbers of all cameras, b of them, are a border of the reduced system (`jaxsfm.core.border`).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

CHUNK = 2048
"""Rows that are linearised at once. A chunk's arrays stay in the cache: 31,843 rows take 33 ms, and
70 ms all at once."""
TOGETHER, STEP = 8, 128
"""Pairs of rows that one product sums, and products at once. 120,000 pairs take 17 ms so, and 60 ms
without steps."""
PAIR_STEPS = 8
"""Where there is room, it holds at least so many steps of pairs for each chunk of rows: those of
tracks of nine photos."""
_SIZES = [2**k * n // 2 for k in range(3, 31) for n in (2, 3)]
"""Of tiles: few, so that few programs are compiled."""
MOST_PHOTOS = 1000
"""So many photos or fewer have a dense reduced system."""
MOST_SHARED = 32
"""If all cameras together have so many numbers or fewer that move, these are a border of the
reduced system, and not part of each photo. For each row, the border costs 18 products for each of
them. As part of a photo, the five numbers of RADIAL cost 250 products for each pair of rows, and
there are two to five times as many pairs as rows."""


class Free(NamedTuple):
    """What may move; everything else is held."""

    poses: Bool[Array, "c 6"]
    """Three numbers of the rotation, which move together, and three of the translation."""
    points: Bool[Array, " p"]
    params: Bool[Array, "k 8"]


class Layout(NamedTuple):
    """Which rows belong together (`layout_of`). Rows are in steps of one length. Those that fill
    the last step belong to the first photo and the first point, and weigh nothing."""

    photo: Int[Array, "s b"]
    point: Int[Array, "s b"]
    camera: Int[Array, " c"]
    """The camera of each photo: a row of `Scene.params`."""
    model: Int[Array, " k"]
    free: Free
    columns: Int[Array, " m"]
    """The columns of `Scene.params` that move for any camera."""
    own: Int[Array, " e"]
    """Those of them that are in the blocks of photos: all of them, or none if they are a border."""
    parent: Int[Array, " c"]
    """The photo that a photo moves relative to; c for the first of each tree, which moves relative
    to the world. So does a photo of which anything is held."""
    host: Int[Array, " p"]
    """The photo that a point moves relative to; c for one without rows. A held point stays."""
    pairs: tuple[Int[Array, "t u 2 8"], Int[Array, "t u"]] | None
    """Pairs of rows of one point, eight for each product, and the block of the matrix of all photos
    that the product belongs to. None if the reduced system is not formed."""
    band: Int[Array, "v w"] | None
    """The photos of each tile if the reduced system is a band (`jaxsfm.core.band`); c after the
    last photo. Then blocks are those of tiles, and of each tile and the next one."""
    used: tuple[Int[Array, ""], Int[Array, ""]]
    """How many steps of rows and of pairs there are. What follows them is room, and costs memory
    only."""


def layout_of(
    photo: Int[np.ndarray, " n"],
    point: Int[np.ndarray, " n"],
    free: Free,
    *,
    camera: Int[np.ndarray, " c"],
    model: Int[np.ndarray, " k"],
    dense: bool | None = None,
    room: bool = False,
) -> Layout:
    """The layout of rows, made on the host (numpy). The sizes of the scene are those of `free`.

    Args:
      photo, point: of each row.
      camera: of each photo.
      model: of each camera (`jaxsfm.core.cameras.intrinsics_of`).
      dense: whether the reduced system is a matrix; by default it is a band if photos can be put
        in such an order and cameras have few numbers that move, and else a matrix up to
        `MOST_PHOTOS` photos.
      room: whether there is room for more rows, up to the next power of four. Then a program serves
        scenes of many sizes.

    Raises:
      ValueError: an index is out of range.
    """
    photos, points, cameras = (len(x) for x in free)
    given = {"photo": (photo, photos), "point": (point, points), "camera": (camera, cameras)}
    for name, (index, end) in given.items():
        if len(index) and not (0 <= np.min(index) and np.max(index) < end):
            raise ValueError(f"{name} must be in 0 to {end - 1}, but has {np.max(index)}")
    photo, point, camera, model = (np.asarray(x, np.int32) for x in (photo, point, camera, model))
    chunk = CHUNK if room else max(min(CHUNK, len(photo)), 1)
    used = -(-len(photo) // chunk)
    end = room_for(len(photo)) if room else used * chunk
    one, other = (np.pad(x, (0, end - len(x))).reshape(-1, chunk) for x in (photo, point))
    columns = np.flatnonzero(np.asarray(free.params).any(0)).astype(np.int32)
    few = cameras * len(columns) <= MOST_SHARED
    band = _band(photo, point, photos) if dense is None and few else None
    if dense is None:
        dense = band is not None or photos <= MOST_PHOTOS
    own = columns[:0] if dense and few else columns
    pairs, products = None, 0
    if dense:
        both = _pairs(point)
        block = photo[both] @ [photos, 1] if band is None else _blocks(photo[both], band, both)
        least = PAIR_STEPS * end // CHUNK if room else None
        *pairs, products = _products(both, block, nothing=end, least=least)
    order = np.lexsort((photo, point))
    parent = _forest(photo[order], point[order], photos)
    host = np.full(points, photos)
    host[point[order[::-1]]] = photo[order[::-1]]
    moves = parent.astype(np.int32), host.astype(np.int32)
    counts = np.int32(used), np.int32(products)
    known = None if pairs is None else tuple(pairs)
    arrays: tuple[Any, ...] = (
        one,
        other,
        camera,
        model,
        free,
        columns,
        own,
        *moves,
        known,
        band,
        counts,
    )
    return Layout(*arrays)


def _forest(photo: np.ndarray, point: np.ndarray, photos: int) -> np.ndarray:
    """The parent of each photo in a tree of most common points; `photos` for the first of each
    tree (Prim's algorithm). Rows are in the order of their points."""
    common = np.zeros((photos, photos), np.int32)
    together = np.flatnonzero(np.diff(point) == 0)
    np.add.at(common, (photo[together], photo[together + 1]), 1)
    common += common.T
    parent, most, left = np.full(photos, photos), np.zeros(photos), np.ones(photos, bool)
    for _ in range(photos):
        new = np.flatnonzero(left)
        best = new[np.argmax(most[new])]
        if most[best] == 0:
            best = new[np.argmax(common[new].sum(1))]
        left[best] = False
        closer = left & (common[best] > most)
        parent[closer], most[closer] = best, common[best][closer]
    return parent


def room_for(rows: int) -> int:
    """The rows of a layout that has room."""
    return CHUNK * _room(-(-rows // CHUNK))


def _room(steps: int, least: int = 1) -> int:
    """The smallest of `least` times 1, 4, 16, ... that holds so many steps."""
    while least < steps:
        least *= 4
    return least


def is_formed(
    photo: Int[np.ndarray, " n"], point: Int[np.ndarray, " n"], photos: int, *, numbers: int
) -> bool:
    """Whether `layout_of` makes a layout whose reduced system is formed.

    Args:
      numbers: how many numbers of all cameras move: cameras times columns.
    """
    few = numbers <= MOST_SHARED
    return photos <= MOST_PHOTOS or (few and _band(photo, point, photos) is not None)


def _band(photo: np.ndarray, point: np.ndarray, photos: int) -> np.ndarray | None:
    """The photos of tiles that have common points only with their own tile and the next one, if
    there are four tiles or more. With fewer, a band saves nothing."""
    if not len(photo):
        return None
    seen = csr_array((np.ones(len(photo)), (point, photo)), shape=(point.max() + 1, photos))
    together = (seen.T @ seen).tocoo()
    order = reverse_cuthill_mckee(together.tocsr(), symmetric_mode=True)
    place = np.argsort(order)
    width = int(np.abs(place[together.row] - place[together.col]).max())
    size = next(n for n in _SIZES if n >= width)
    tiles = -(-photos // size)
    if tiles < 4:
        return None
    band = np.full(tiles * size, photos, np.int32)
    band[:photos] = order
    return band.reshape(tiles, size)


def _blocks(photo: np.ndarray, band: np.ndarray, both: np.ndarray) -> np.ndarray:
    """The blocks of tiles for pairs of rows (n, 2), which are put in the order of their photos."""
    place = np.argsort(band.ravel(), kind="stable")[photo]
    later = place[:, 0] > place[:, 1]
    both[later], place[later] = both[later, ::-1], place[later, ::-1]
    size = band.shape[1]
    (tile, other), (row, column) = (place // size).T, (place % size).T
    return ((2 * tile + other - tile) * size + row) * size + column


def _pairs(point: np.ndarray) -> np.ndarray:
    """Every pair of rows of one point once, int (n, 2)."""
    order = np.argsort(point, kind="stable")
    _, first, count = np.unique(point[order], return_index=True, return_counts=True)
    after = np.repeat(first + count, count) - np.arange(len(order)) - 1
    one = np.repeat(np.arange(len(order)), after)
    other = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(after) - after, after)
    return order[np.stack([one, other], axis=1)]


def _products(
    both: np.ndarray, block: np.ndarray, *, nothing: int, least: int | None
) -> tuple[np.ndarray, np.ndarray, int]:
    """Pairs of rows by their blocks, and how many steps that takes; `nothing` is padding. Unless
    `least` is None, there is room (`_room`)."""
    by_block = np.argsort(block, kind="stable")
    block, first, count = np.unique(block[by_block], return_index=True, return_counts=True)
    products = -(-count // TOGETHER)
    within = np.arange(len(both)) - np.repeat(first, count)
    at = np.repeat(np.cumsum(products) - products, count) + within // TOGETHER
    step = max(min(STEP, products.sum()), 1) if least is None else STEP
    used = max(-(-int(products.sum()) // int(step)), 1)
    end = (used if least is None else _room(used, least)) * step
    rows, blocks = np.full((end, 2, TOGETHER), nothing, np.int32), np.zeros(end, np.int32)
    rows[at, :, within % TOGETHER] = both[by_block]
    blocks[: products.sum()] = np.repeat(block, products)
    return rows.reshape(-1, step, 2, TOGETHER), blocks.reshape(-1, step), used


def places(layout: Layout) -> Int[Array, "c f"]:
    """Where the f numbers of each photo are among all z: six of its pose, and those of its camera,
    which come after all poses."""
    photos, columns = len(layout.camera), len(layout.columns)
    pose = jnp.arange(6 * photos, dtype=jnp.int32).reshape(photos, 6)
    own = layout.camera[:, None] * columns + jnp.arange(columns, dtype=jnp.int32)
    return jnp.concatenate([pose, 6 * photos + own], axis=1)


def gathered(x: Float[Array, "c f"], layout: Layout) -> Float[Array, " z"]:
    """All numbers from those of each photo: sums over the photos of each camera."""
    size = 6 * len(layout.camera) + len(layout.model) * len(layout.columns)
    return jnp.zeros(size, x.dtype).at[places(layout)].add(x)
