"""Competition of planes for their correspondences.

Peeling is greedy: the first plane takes every correspondence within its threshold, also those that
fit a later plane far better, and its refit is pulled towards them. So after peeling every
correspondence is given to the plane with the smallest error, and every plane is fitted again to its
own correspondences, in turn, as in k-means.

Source: Isack and Boykov 2012, "Energy-based geometric multi-model fitting", without their
smoothness term.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core import homography as hg
from jaxsfm.core.lanes import in_turn_on_cpus
from jaxsfm.core.types import Correspondences


def nearest_plane(
    h: Float[Array, "p 3 3"],
    alive: Bool[Array, " p"],
    found: Correspondences,
    threshold: Float[Array, ""],
) -> Int[Array, " k"]:
    """The living plane with the smallest one-way error below the threshold, or -1."""
    square = jnp.where(alive[:, None], hg.transfer_error(h, found.xy0, found.xy1), jnp.inf)
    best = jnp.argmin(square, axis=0).astype(jnp.int32)
    near = found.valid & (jnp.min(square, axis=0) < threshold * threshold)
    return jnp.where(near, best, -1)


def settle(
    h: Float[Array, "p 3 3"],
    num: Int[Array, " p"],
    found: Correspondences,
    threshold: Float[Array, ""],
    floor: Int[Array, ""],
    *,
    rounds: int,
) -> tuple[Float[Array, "p 3 3"], Int[Array, " p"], Int[Array, " k"]]:
    """Planes, their numbers of members and the plane of each correspondence after `rounds` rounds.

    A plane that is left with fewer than `floor` members is given up, and its correspondences go to
    the other planes. The result is ordered by the number of members, the largest plane first.

    Args:
      h: planes in the coordinates of `found`.
      num: members of each plane; 0 where there is no plane.
      found: normalised correspondences.
      threshold: largest error of a member, in image 1, in the same coordinates.
    """
    which = jnp.arange(h.shape[0], dtype=jnp.int32)
    fit = jax.vmap(in_turn_on_cpus(hg.least_squares), in_axes=(None, None, 0))

    def members(h, alive):
        plane = nearest_plane(h, alive, found, threshold)
        return plane, plane[None, :] == which[:, None]

    def turn(state, _):
        h, alive = state
        _, mine = members(h, alive)
        alive = alive & (mine.sum(axis=1, dtype=jnp.int32) >= floor)
        weights = mine.astype(found.xy0.dtype)
        fitted = fit(found.xy0, found.xy1, weights)
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
