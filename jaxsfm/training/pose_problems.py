"""Problems whose answer is poses: what keypoints are worth, as one differentiable number.

Photos with known poses are matched once. A *track* is the fine cells that matches join, at most one
in each photo. The maps inside these cells are kept as arrays, so a step of a training never runs
the network. A function of the maps, which is to be learned, puts a keypoint and its weight into
each cell; a bundle adjustment turns them into poses; and the loss is how far these are from the
known ones (`jaxsfm.core.bundle`).

All problems of one size have the same rows, a photo and a track each, so they share one program.
Rows of cells that there are not weigh nothing.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxsfm.colmap.intrinsics import Intrinsics, check_fits
from jaxsfm.colmap.poses import Poses as PosesByName
from jaxsfm.config import preset
from jaxsfm.core.bundle import Adjustment, adjust, frame_held, pose_loss, triangulated
from jaxsfm.core.bundle_layout import Free, Layout, layout_of
from jaxsfm.core.bundle_problem import Observations, Poses, Scene
from jaxsfm.core.cameras import intrinsics_of
from jaxsfm.core.grid import FINE_STRIDE
from jaxsfm.core.relocalize import Variant, relocalize
from jaxsfm.core.vgg import VGG16, Preprocessing, preprocess
from jaxsfm.errors import UserError
from jaxsfm.io.features import padded_size
from jaxsfm.io.images import ImageFile, read_image
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.weights import Weights
from jaxsfm.matching.pipeline import extract, match
from jaxsfm.training.objective import scored
from jaxsfm.training.photos import MAX_ERROR_PX, camera_matrix, neighbours

Maps = tuple[Float[Array, "n 8 8 64"], Float[Array, "n 4 4 64"], Float[Array, "n 2 2 128"]]
"""The maps inside fine cells: conv1_2 (pixels), pool1 and pool2."""
Tree = TypeVar("Tree")


class PosedTracks(NamedTuple):
    """The tracks of a set of photos, and what is known of the photos (arrays of numpy)."""

    names: list[str]
    maps: tuple[np.ndarray, ...]
    """float32 `Maps` of all cells."""
    corner: np.ndarray
    """float32 (n, 2): the (x, y) of each cell's first pixel, working pixels."""
    cell: np.ndarray
    """int32 (photos, tracks): the cell by which a photo sees a track, or -1."""
    poses: Poses
    """float64, of the photos; world units."""
    params: np.ndarray
    """float64 (1, 8): a PINHOLE camera in working pixels (`jaxsfm.core.cameras`)."""


class PoseProblem(NamedTuple):
    """Some photos and some of their tracks; rows are in the order of `pose_layout`."""

    maps: Maps
    corner: Float[Array, "n 2"]
    seen: Float[Array, " n"]
    """1 where the photo sees the track, else 0."""
    poses: Poses
    params: Float[Array, "1 8"]


def pose_layout(photos: int, tracks: int, *, dense: bool | None = None) -> Layout:
    """The rows of problems of one size: all tracks of the first photo, then those of the second,
    and so on. Points are free. Of the poses `pose_error` says what is held. `dense` is as in
    `layout_of`."""
    photo, point = np.mgrid[:photos, :tracks].reshape(2, -1)
    # Arrays of numpy still, as those of the layout.
    free: tuple[Any, ...] = (
        np.ones((photos, 6), bool),
        np.ones(tracks, bool),
        np.zeros((1, 8), bool),
    )
    _, model = intrinsics_of(["PINHOLE"], [[1.0, 1.0, 0.0, 0.0]])
    return layout_of(
        photo, point, Free(*free), camera=np.zeros(photos, np.int32), model=model, dense=dense
    )


def pose_error(
    at: Float[Array, "n 2"],
    weight: Float[Array, " n"],
    problem: PoseProblem,
    layout: Layout,
    *,
    scale: float = math.inf,
) -> tuple[Float[Array, ""], Adjustment]:
    """How far the poses that follow from keypoints are from the known ones (`pose_loss`), and the
    adjustment. Its gradient in the keypoints and their weights is zero without `converged`.

    The adjustment starts at the known poses, which says near which minimum it searches. Call it in
    `jax.enable_x64(True)`: poses are float64.

    Args:
      at: places in the cells, (x, y) from the centre of a cell's first pixel, pixels.
      weight: of each keypoint; cells that are not seen have none in any case.
      layout: of the problem's size.
      scale: as in `adjust`, pixels. No keypoint is off by much more than a cell, so least squares
        serve, and they need a quarter of the steps.
    """
    seen = _wide(Observations(problem.corner + at, weight * problem.seen))
    poses, params = _wide((problem.poses, problem.params))
    layout = jax.tree.map(jnp.asarray, layout)
    layout = layout._replace(free=layout.free._replace(poses=frame_held(poses)))
    start = Scene(poses, triangulated(poses, params, seen, layout), params)
    found = adjust(start, seen, layout, scale=scale)
    return pose_loss(found.scene.poses, poses), found


def _wide(tree: Tree) -> Tree:
    return jax.tree.map(lambda x: jnp.asarray(x).astype(jnp.float64), tree)


def walk_in_cells(
    scores: dict | None, maps: Maps, *, variant: Variant, temperature: float = 0.5
) -> Float[Array, "n 2"]:
    """Where the cells' walks end (`jaxsfm.core.relocalize.relocalize`).

    Args:
      scores: parameters of `jaxsfm.core.scores.Scores`; None stands for the norm rule.
    """
    start = jnp.zeros(1, jnp.int32)

    def one(*levels: Array) -> Array:
        ends = relocalize(levels, start, start, variant=variant, temperature=temperature)
        return ends[0]

    return jax.vmap(one)(*scored(scores, maps))


def draw(tracks: PosedTracks, rng: np.random.Generator, *, photos: int, count: int) -> PoseProblem:
    """A problem of so many photos, one of them and others that share many tracks with it, and of so
    many of their tracks, all at random. If there are fewer tracks, rows are left empty.

    Raises:
      ValueError: there are fewer photos.
    """
    if not 2 <= photos <= len(tracks.names):
        raise ValueError(f"photos must be 2 to {len(tracks.names)}; got {photos}")
    seen = tracks.cell >= 0
    first = int(rng.integers(len(seen)))
    shared = (seen & seen[first]).sum(1).astype(float)
    shared[first] = np.inf
    with np.errstate(divide="ignore"):  # by probabilities in the ratio of the shares
        order = np.argsort(-np.log(shared) - rng.gumbel(size=len(seen)), kind="stable")
    chosen = order[:photos]
    views = seen[chosen].sum(0)
    some = rng.permutation(np.flatnonzero(views >= 2))
    # Two photos do not say how long their baseline is beside that of others; three do.
    some = some[np.argsort(views[some] < 3, kind="stable")][:count]
    cell = np.full((photos, count), -1)
    cell[:, : len(some)] = tracks.cell[np.ix_(chosen, some)]
    rows = cell.ravel()
    parts: tuple[Any, ...] = (
        tuple(x[rows] for x in tracks.maps),
        tracks.corner[rows],
        (rows >= 0).astype(np.float32),
        Poses(*(x[chosen] for x in tracks.poses)),
        tracks.params,
    )
    return PoseProblem(*parts)


def posed_tracks(
    weights: Weights,
    images: Sequence[ImageFile],
    poses: PosesByName,
    intrinsics: Intrinsics,
    *,
    max_size: int,
    most: int = 2000,
    seed: int = 0,
) -> PosedTracks:
    """Match the photos that have a pose, by the preset `paper`, and keep the maps in their tracks.

    A photo is matched with those whose cameras are near. A track counts if the centres of all its
    cells lie within a cell's side of where its point is seen from the known poses.

    Args:
      images: the photos; those without a pose are left out.
      intrinsics: one pinhole camera for all photos.
      max_size: longer side of the working images, pixels.
      most: so many tracks are kept, the longest ones. A cell takes 22 kB.
      seed: of the matching.

    Raises:
      UserError: fewer than two photos have a pose, nothing matches, the camera has distortion, or
        the photos differ in size.
    """
    images = sorted((x for x in images if x.name in poses), key=lambda x: x.name)
    if len(images) < 2:
        raise UserError(f"--reference: {len(images)} of the photos have a pose; 2 are needed")
    check_fits(intrinsics, {image.name: image.size for image in images})
    names = [image.name for image in images]
    config = dataclasses.replace(preset("paper"), max_size=max_size)
    features = extract(weights, images, config=config)
    found = match(features, neighbours(names, poses), config=config, seed=seed).values()
    photo, cell, track = _joined(names, list(found))
    columns = np.asarray([int(features[name].dense.fine_grid[1]) for name in names])
    corner = FINE_STRIDE * np.stack(np.divmod(cell, columns[photo])[::-1], axis=1)
    k = camera_matrix(intrinsics, features[names[0]].scale)
    params, _ = intrinsics_of(["PINHOLE"], [[k[0, 0], k[1, 1], k[0, 2], k[1, 2]]])
    rotations = np.stack([poses[name].rotation for name in names])
    centres = np.stack([poses[name].centre for name in names])
    pose: tuple[Any, ...] = rotations, -np.einsum("cij,cj->ci", rotations, centres)
    known = Poses(*pose)
    table = np.full((len(names), track.max(initial=-1) + 1), -1)
    table[photo, track] = np.arange(len(track))
    table = table[:, _fits(known, params, corner + (FINE_STRIDE - 1) / 2, table)]
    longest = np.argsort(-(table >= 0).sum(0), kind="stable")[:most]
    table = table[:, np.sort(longest)]
    if not table.size:
        raise UserError("--reference: no two photos with a pose have matches that agree with it")
    rows = table[table >= 0]  # those of the first photo come first
    counts = np.bincount(photo[rows], minlength=len(names))
    parts = [
        _maps_in_cells(weights, image, max_size, corner[some] // FINE_STRIDE)
        for image, some in zip(images, np.split(rows, np.cumsum(counts)[:-1]), strict=True)
    ]
    table[table >= 0] = np.arange(len(rows))
    maps = tuple(np.concatenate(part) for part in zip(*parts, strict=True))
    return PosedTracks(
        names, maps, corner[rows].astype(np.float32), table.astype(np.int32), known, params
    )


def _joined(names: list[str], found: list[PairResult]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The photo, the cell and the track of each cell that matches join. Tracks that have two cells
    in a photo are left out."""
    columns = max((int(result.cells.max(initial=0)) for result in found), default=0) + 1
    ends = [
        result.cells.astype(np.int64) + columns * np.asarray([names.index(x) for x in result.pair])
        for result in found
    ]
    ends = np.concatenate([np.zeros((0, 2), np.int64), *ends])
    if not len(ends):
        none = np.zeros(0, np.int64)
        return none, none, none
    nodes, edges = np.unique(ends, return_inverse=True)
    one, other = edges.reshape(-1, 2).T
    graph = coo_array((np.ones(len(one)), (one, other)), shape=(len(nodes),) * 2)
    _, track = connected_components(graph, directed=False)
    photo, cell = np.divmod(nodes, columns)
    in_photo, times = np.unique(np.stack([track, photo]), axis=1, return_counts=True)
    keep = ~np.isin(track, in_photo[0, times > 1])
    _, track = np.unique(track[keep], return_inverse=True)
    return photo[keep], cell[keep], track


def _fits(known: Poses, params: np.ndarray, xy: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Whether all places (n, 2) of a track lie near those of one point, seen from known poses."""
    if not table.size:
        return np.zeros(table.shape[1], bool)
    seen: tuple[Any, ...] = xy[table].reshape(-1, 2), (table >= 0).astype(float).ravel()
    with jax.enable_x64(True):
        layout = pose_layout(*table.shape, dense=False)
        points = jax.jit(triangulated)(known, params, Observations(*seen), layout)
    x = np.asarray(points)
    rays = np.einsum("cij,pj->cpi", known.rotations, x[:, :3])
    rays += x[:, 3:] * known.translations[:, None]
    there = rays[..., :2] / rays[..., 2:] * params[0, :2] + params[0, 2:4]
    error = np.linalg.norm(there - xy[table], axis=-1)
    return np.all(np.where(table >= 0, error, 0.0) < MAX_ERROR_PX, axis=0)


@functools.partial(jax.jit, static_argnames="preprocessing")
def _walked(params: dict, image: Array, size: Int[Array, " 2"], *, preprocessing: Preprocessing):
    x = preprocess(image, preprocessing)
    return VGG16().apply(params, x[None], size[None], method="walked")


def _maps_in_cells(
    weights: Weights, image: ImageFile, max_size: int, cells: np.ndarray
) -> list[np.ndarray]:
    """The maps inside cells (n, 2), (column, row), of a photo."""
    rgb = read_image(image, max_size=max_size, upright=True).rgb
    height, width = padded_size(rgb.shape[1::-1])
    padded = np.pad(rgb, ((0, height - rgb.shape[0]), (0, width - rgb.shape[1]), (0, 0)))
    size = np.asarray(rgb.shape[:2], np.int32)
    kept = []
    for x in _walked(weights.params, padded, size, preprocessing=weights.preprocessing):
        whole = np.asarray(x[0])
        side = whole.shape[0] * FINE_STRIDE // height
        blocks = whole.reshape(-1, side, width // FINE_STRIDE, side, whole.shape[-1])
        kept.append(blocks[cells[:, 1], :, cells[:, 0]])
    return kept
