"""Losses of relocalization, as differentiable functions of where its walks end.

Given are cells of two images that see the same place, and the map between the images: a homography,
or the epipolar geometry of two known cameras. The hard walk succeeds if the two keypoints meet. The
expectation of that over random walks (`jaxsfm.core.relocalize.walk`) is a sum over all pairs of
pixels of the two cells. It is exact, without sampling.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.grid import FINE_STRIDE, cell_rows_cols, cell_to_px
from jaxsfm.core.homography import homogeneous
from jaxsfm.core.numerics import HIGHEST
from jaxsfm.core.relocalize import WalkProbabilities, window_positions
from jaxsfm.core.views import warp_points


class CellPairs(NamedTuple):
    """Fine cells of two images that see the same place."""

    cell0: Int[Array, "m 2"]
    """(row, column) in image 0."""
    cell1: Int[Array, "m 2"]
    weight: Float[Array, " m"]
    """1 for a pair, 0 for a row that is none."""


def cells_under_homography(
    h: Float[Array, "3 3"],
    offsets: Float[Array, "m 2"],
    *,
    rows: int,
    cols: int,
    margin: int = 1,
) -> CellPairs:
    """For every fine cell of image 0 the cell of image 1 that its centre falls into.

    Args:
      h: maps pixels of image 0 to pixels of image 1.
      offsets: added to the mapped centres, pixels. They imitate descriptors, which may find a
        cell beside the right one.
      rows, cols: the grid of fine cells of either image.
      margin: cells that are this close to a border do not count.
    """
    row, col = cell_rows_cols(rows * cols, jnp.int32(cols))
    centre = cell_to_px(jnp.stack([col, row], axis=-1).astype(jnp.float32), stride=FINE_STRIDE)
    # The centre of a pixel has whole coordinates; the first edge of its cell lies half a pixel
    # before.
    found = jnp.floor((warp_points(h, centre) + offsets + 0.5) / FINE_STRIDE)
    found = jnp.where(jnp.isfinite(found), found, -1.0)

    def inside(r, c):
        return (r >= margin) & (r < rows - margin) & (c >= margin) & (c < cols - margin)

    seen = inside(found[:, 1], found[:, 0]) & inside(row, col)
    # Points that the map puts behind the camera are not seen.
    seen &= jnp.einsum("j,nj->n", h[2], homogeneous(centre), precision=HIGHEST) * h[2, 2] > 0
    cell1 = jnp.where(seen[:, None], found[:, ::-1], 0.0).astype(jnp.int32)
    return CellPairs(jnp.stack([row, col], axis=-1), cell1, seen.astype(jnp.float32))


def transfer_distances(
    h: Float[Array, "3 3"], walks0: WalkProbabilities, walks1: WalkProbabilities
) -> Float[Array, "m n n"]:
    """Squared distances, in pixels of image 1, between every place where the first walk may end,
    mapped by a homography, and every place where the second walk may end."""
    moved = warp_points(h, window_positions(walks0))
    apart = moved[:, :, None] - window_positions(walks1)[:, None]
    return jnp.sum(apart**2, axis=-1)


def epipolar_distances(
    f: Float[Array, "3 3"], walks0: WalkProbabilities, walks1: WalkProbabilities
) -> Float[Array, "m n n"]:
    """Squared Sampson distances, pixels, of all pairs of places where the two walks may end.

    Args:
      f: fundamental matrix, x1' F x0 = 0.
    """
    return sampson_distances(
        f, window_positions(walks0)[:, :, None], window_positions(walks1)[:, None]
    )


def sampson_distances(
    f: Float[Array, "3 3"], xy0: Float[Array, "*n 2"], xy1: Float[Array, "*m 2"]
) -> Float[Array, "*k"]:
    """Squared distance, to first order, of matches to the nearest ones that fit F exactly.

    Leading axes broadcast. The value is finite at the epipoles too.

    Source: Hartley and Zisserman 2004, section 11.4.3.
    """
    line1 = jnp.einsum("ij,...j->...i", f, homogeneous(xy0), precision=HIGHEST)
    line0 = jnp.einsum("ji,...j->...i", f, homogeneous(xy1), precision=HIGHEST)
    residual = jnp.sum(line1 * homogeneous(xy1), axis=-1)
    normals = jnp.sum(line1[..., :2] ** 2, axis=-1) + jnp.sum(line0[..., :2] ** 2, axis=-1)
    safe = jnp.where(normals > 0, normals, 1.0)
    return jnp.where(normals > 0, residual**2 / safe, 0.0)


def agreement(
    walks0: WalkProbabilities,
    walks1: WalkProbabilities,
    squared: Float[Array, "m n n"],
    *,
    sigma: float,
) -> Float[Array, " m"]:
    """How well the ends of two walks agree, in [0, 1]: the mean of exp(-d^2 / (2 sigma^2)).

    Args:
      squared: squared distances d^2 between places of the first and the second walk, pixels^2.
      sigma: distance at which places still agree, pixels.
    """
    return _mean_over_ends(walks0, walks1, jnp.exp(-0.5 * squared / sigma**2))


def mean_distance(
    walks0: WalkProbabilities,
    walks1: WalkProbabilities,
    squared: Float[Array, "m n n"],
    *,
    most: float,
) -> Float[Array, " m"]:
    """Mean distance, pixels, between the places where two walks end. Distances above `most` count
    as `most`."""
    near = squared < most**2
    # The gradient of the root is infinite at 0, so distances start at a thousandth of a pixel.
    apart = jnp.where(near, jnp.sqrt(jnp.where(near, squared, 1.0) + 1e-6), most)
    return _mean_over_ends(walks0, walks1, apart)


def peakiness(walks: WalkProbabilities) -> Float[Array, " m"]:
    """How certain the end of a walk is: 1 - entropy / log(places). It is 1 if there is one place,
    and 0 if all places are equally probable.

    Source: the entropy form of the peakiness losses of detectors (R2D2, Revaud et al. 2019).
    """
    p = _flat(walks)
    log = jnp.log(jnp.where(p > 0, p, 1.0))
    return 1 + jnp.sum(p * log, axis=-1) / math.log(p.shape[1])


def weighted_mean(values: Float[Array, " m"], weight: Float[Array, " m"]) -> Float[Array, ""]:
    """The weighted mean of values; 0 if all weights are 0."""
    total = jnp.sum(weight)
    mean = jnp.sum(jnp.where(weight > 0, values, 0.0) * weight) / jnp.where(total > 0, total, 1.0)
    return jnp.where(total > 0, mean, 0.0)


def _mean_over_ends(
    walks0: WalkProbabilities, walks1: WalkProbabilities, values: Float[Array, "m n n"]
) -> Float[Array, " m"]:
    first = jnp.einsum("mij,mj->mi", values, _flat(walks1), precision=HIGHEST)
    return jnp.sum(first * _flat(walks0), axis=-1)


def _flat(walks: WalkProbabilities) -> Float[Array, "m n"]:
    return walks.p.reshape(walks.p.shape[0], -1)


def share_within(
    squared: Float[Array, " m"], counts: Bool[Array, " m"], *, px: float
) -> Float[Array, ""]:
    """The share, among the matches that count, of those within `px` pixels; 0 if none counts."""
    return weighted_mean((squared <= px**2).astype(jnp.float32), counts.astype(jnp.float32))
