"""What a relocalizer should do, as differentiable functions of where its walks end.

Cells of two images that see the same place, and what is known of the map between the images: a
homography, or the epipolar geometry of two known cameras. The hard walk's success is whether two
keypoints meet; its expectation over random walks (`jaxsfm.core.relocalize.walk`) is a sum over the
pairs of pixels of two cells, exact and without sampling.
"""

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
    """0 where there is no such pair."""


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
      h: image 0 to image 1, pixels; both have rows x cols fine cells.
      offsets: added to the mapped centres, pixels: descriptors find a cell near the right one.
      margin: cells this close to a border do not count.
    """
    row, col = cell_rows_cols(rows * cols, jnp.int32(cols))
    centre = cell_to_px(jnp.stack([col, row], axis=-1).astype(jnp.float32), stride=FINE_STRIDE)
    # A pixel's centre is a whole number, its cell's first edge half a pixel before.
    found = jnp.floor((warp_points(h, centre) + offsets + 0.5) / FINE_STRIDE)
    found = jnp.where(jnp.isfinite(found), found, -1.0)

    def inside(r, c):
        return (r >= margin) & (r < rows - margin) & (c >= margin) & (c < cols - margin)

    seen = inside(found[:, 1], found[:, 0]) & inside(row, col)
    # Where the map turns over (behind the camera) nothing is seen.
    seen &= jnp.einsum("j,nj->n", h[2], homogeneous(centre), precision=HIGHEST) * h[2, 2] > 0
    cell1 = jnp.where(seen[:, None], found[:, ::-1], 0.0).astype(jnp.int32)
    return CellPairs(jnp.stack([row, col], axis=-1), cell1, seen.astype(jnp.float32))


def transfer_distances(
    h: Float[Array, "3 3"], walks0: WalkProbabilities, walks1: WalkProbabilities
) -> Float[Array, "m n n"]:
    """Squared distances, pixels of image 1, of every place where the first walk may end, mapped by
    a homography, from every one of the second's."""
    moved = warp_points(h, window_positions(walks0))
    apart = moved[:, :, None] - window_positions(walks1)[:, None]
    return jnp.sum(apart**2, axis=-1)


def epipolar_distances(
    f: Float[Array, "3 3"], walks0: WalkProbabilities, walks1: WalkProbabilities
) -> Float[Array, "m n n"]:
    """Squared Sampson distances, pixels, of the same places to a fundamental matrix.

    Args:
      f: x1' F x0 = 0.
    """
    return sampson_distances(
        f, window_positions(walks0)[:, :, None], window_positions(walks1)[:, None]
    )


def sampson_distances(
    f: Float[Array, "3 3"], xy0: Float[Array, "*n 2"], xy1: Float[Array, "*m 2"]
) -> Float[Array, "*k"]:
    """Squared distance of matches to the nearest exact ones, to first order; leading axes
    broadcast. Finite at the epipoles too.

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
    """Probability that two walks end in places that agree, in [0, 1]: the mean of
    exp(-d^2 / (2 sigma^2)) over both.

    Args:
      squared: distances d^2 of their places, pixels squared.
      sigma: how far apart places agree, pixels.
    """
    return _mean_over_ends(walks0, walks1, jnp.exp(-0.5 * squared / sigma**2))


def mean_distance(
    walks0: WalkProbabilities,
    walks1: WalkProbabilities,
    squared: Float[Array, "m n n"],
    *,
    most: float,
) -> Float[Array, " m"]:
    """Mean distance of the places where two walks end, each at most `most`, pixels."""
    near = squared < most**2
    # The root's gradient at 0 is infinite; half a thousandth of a pixel is not.
    apart = jnp.where(near, jnp.sqrt(jnp.where(near, squared, 1.0) + 1e-6), most)
    return _mean_over_ends(walks0, walks1, apart)


def peakiness(walks: WalkProbabilities) -> Float[Array, " m"]:
    """How sure a walk is of its end: 1 - entropy / log(places), 1 for one place, 0 for all alike.

    Source: the entropy form of the peakiness losses of detectors (R2D2, Revaud et al. 2019).
    """
    p = _flat(walks)
    log = jnp.log(jnp.where(p > 0, p, 1.0))
    return 1 + jnp.sum(p * log, axis=-1) / jnp.log(p.shape[1])


def weighted_mean(values: Float[Array, " m"], weight: Float[Array, " m"]) -> Float[Array, ""]:
    """Of what counts; 0 if nothing does."""
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
    """Share of the matches that count whose squared distance is within px; 0 if none does."""
    return weighted_mean((squared <= px**2).astype(jnp.float32), counts.astype(jnp.float32))
