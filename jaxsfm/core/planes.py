"""Planes compete for their correspondences.

Peeling is greedy: the first plane takes whatever lies within its threshold, also what fits a later
plane far better, and is pulled towards it by the refit. So afterwards every correspondence goes to
the plane with the least error and every plane is fitted again to its own, in turn, as in k-means
(Isack and Boykov 2012, "Energy-based geometric multi-model fitting", without their smoothness
term).
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core import homography as hg


def nearest_plane(
    h: Float[Array, "p 3 3"],
    alive: Bool[Array, " p"],
    xy0: Float[Array, "k 2"],
    xy1: Float[Array, "k 2"],
    valid: Bool[Array, " k"],
    threshold: Float[Array, ""],
) -> Int[Array, " k"]:
    """The living plane with the least one-way error below the threshold, or -1."""
    square = jnp.where(alive[:, None], hg.transfer_error(h, xy0, xy1), jnp.inf)
    best = jnp.argmin(square, axis=0).astype(jnp.int32)
    near = valid & (jnp.min(square, axis=0) < threshold * threshold)
    return jnp.where(near, best, -1)


def settle(
    h: Float[Array, "p 3 3"],
    num: Int[Array, " p"],
    xy0: Float[Array, "k 2"],
    xy1: Float[Array, "k 2"],
    valid: Bool[Array, " k"],
    threshold: Float[Array, ""],
    floor: Int[Array, ""],
    *,
    rounds: int,
) -> tuple[Float[Array, "p 3 3"], Int[Array, " p"], Int[Array, " k"]]:
    """Planes, members and the plane of each correspondence after `rounds` of competition.

    A plane left with fewer than `floor` members is given up, its correspondences go to the others.
    The largest plane comes first.

    Args:
      h: planes in the coordinates of xy0 and xy1 (normalised).
      num: members; 0 where there is no plane.
      threshold: largest error, in image 1.
    """
    which = jnp.arange(h.shape[0], dtype=jnp.int32)

    def members(h, alive):
        plane = nearest_plane(h, alive, xy0, xy1, valid, threshold)
        return plane, plane[None, :] == which[:, None]

    def turn(state, _):
        h, alive = state
        _, mine = members(h, alive)
        alive = alive & (mine.sum(axis=1, dtype=jnp.int32) >= floor)
        fitted = lax.map(lambda w: hg.least_squares(xy0, xy1, w), mine.astype(xy0.dtype))
        return (jnp.where(alive[:, None, None], fitted, h), alive), None

    (h, alive), _ = lax.scan(turn, (h, num > 0), length=rounds)
    _, mine = members(h, alive)
    alive &= mine.sum(axis=1, dtype=jnp.int32) >= floor
    plane, mine = members(h, alive)
    count = jnp.where(alive, mine.sum(axis=1, dtype=jnp.int32), 0)
    order = jnp.argsort(-count, stable=True)
    place = jnp.argsort(order).astype(jnp.int32)
    plane = jnp.where(plane >= 0, place[plane], -1)
    return h[order], count[order], plane
