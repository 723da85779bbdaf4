"""The program for one pair: coarse matches, fine correspondences, planes, one-to-one matches.

The octaves of the images are joined before (`jaxsfm.core.octaves.join_octaves`), once per image and
not once per pair. `match_pairs` computes a batch of pairs.
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxsfm.core import coarse_to_fine as c2f
from jaxsfm.core.consensus import consensus_nn
from jaxsfm.core.matching import mutual_nn
from jaxsfm.core.numerics import one_by_one
from jaxsfm.core.pair_shape import PairShape
from jaxsfm.core.ransac import peel_planes
from jaxsfm.core.types import (
    DescriptorGrid,
    JoinedFeatures,
    PairMatches,
    Planes,
    PRNGKey,
    Status,
    Thresholds,
)


def pair_key(root: PRNGKey, identity0: int | Array, identity1: int | Array) -> PRNGKey:
    """The key of a pair, from the identities (uint32) of its images in either order.

    It does not depend on the place of the pair in a batch, on other pairs or on the machine.
    """
    a, b = jnp.uint32(identity0), jnp.uint32(identity1)
    return jax.random.fold_in(jax.random.fold_in(root, jnp.minimum(a, b)), jnp.maximum(a, b))


@functools.partial(jax.jit, static_argnames=("shape",))
def match_pair(
    key: PRNGKey,
    features0: JoinedFeatures,
    features1: JoinedFeatures,
    thresholds: Thresholds,
    *,
    shape: PairShape,
) -> PairMatches:
    """Verified matches of one pair (paper, section 3).

    There is one compilation for each feature capacity and `PairShape`; thresholds and grid sizes
    are traced. If the pair fails, `status` gives the reason.

    Args:
      key: from `pair_key`.
      features0, features1: features of the two working images.
      thresholds: pixels of the working images.
    """
    # The platform is known when the program is compiled, which may be on another machine.
    return lax.platform_dependent(
        key,
        features0,
        features1,
        jax.tree.map(jnp.asarray, thresholds),
        cpu=functools.partial(_match_pair, shape=shape),
        default=functools.partial(_match_pair, shape=shape.for_accelerators()),
    )


def _match_pair(
    key: PRNGKey,
    features0: JoinedFeatures,
    features1: JoinedFeatures,
    thresholds: Thresholds,
    *,
    shape: PairShape,
) -> PairMatches:
    if shape.consensus:
        coarse = consensus_nn(
            DescriptorGrid(features0.coarse, features0.coarse_grid, features0.coarse_parts),
            DescriptorGrid(features1.coarse, features1.coarse_grid),
            radius=shape.consensus,
            columns=shape.coarse_columns,
            tile=shape.coarse_tile,
        )
    else:
        coarse = mutual_nn(features0.coarse, features1.coarse, tile=shape.coarse_tile)
    cells, found = tentative_matches(features0, features1, coarse, shape=shape)
    valid = jnp.arange(cells.shape[0], dtype=jnp.int32) < found
    xy0, xy1 = features0.keypoints[cells[:, 0]], features1.keypoints[cells[:, 1]]
    planes = peel_planes(key, xy0, xy1, valid, thresholds, shape=shape)
    if shape.one_to_one == "similarity":
        score = c2f.similarities(features0, features1, cells, found)
    else:
        score = jnp.zeros((cells.shape[0],), jnp.float32)
    num_fine = max(features0.fine.shape[0], features1.fine.shape[0])
    kept = c2f.one_to_one(cells, planes.plane >= 0, score, num_cells=num_fine)
    planes = planes._replace(plane=jnp.where(kept, planes.plane, -1))
    return pair_matches(coarse, cells, found, planes, thresholds)


def tentative_matches(
    features0: JoinedFeatures,
    features1: JoinedFeatures,
    coarse: Int[Array, " n"],
    *,
    shape: PairShape,
) -> tuple[Int[Array, "k 2"], Int[Array, ""]]:
    """Fine cells of both images that correspond inside the windows of coarse matches, in index
    order, and how many were found, also beyond the capacity k.

    Args:
      coarse: for every coarse cell of image 0 its match in image 1, or -1.
    """
    num_fine = max(features0.fine.shape[0], features1.fine.shape[0])
    capacity = max(int(shape.correspondences_per_cell * num_fine), 1)
    windows = c2f.match_windows(features0, features1, coarse, chunk=shape.fine_chunk)
    return c2f.correspondences(c2f.candidates(windows, features0), capacity=capacity)


def pair_matches(
    coarse: Int[Array, " n"],
    cells: Int[Array, "k 2"],
    found: Int[Array, ""],
    planes: Planes,
    thresholds: Thresholds,
) -> PairMatches:
    """What a pair ends with, and its status.

    Args:
      coarse: for every coarse cell of image 0 its match, or -1.
      cells: the tentative matches.
      found: how many were found, also beyond the capacity k.
      planes: the planes, with -1 for matches that do not count.
    """
    floor = jnp.asarray(thresholds.min_inliers, jnp.int32)
    status = jnp.where(
        planes.num_inliers[0] > 0,
        Status.VERIFIED,
        jnp.where(found < floor, Status.TOO_FEW_MATCHES, Status.NO_PLANE),
    )
    return PairMatches(
        cells=cells,
        plane=planes.plane,
        homographies=planes.homographies,
        num_inliers=planes.num_inliers,
        num_coarse=jnp.sum(coarse >= 0, dtype=jnp.int32),
        num_tentative=found,
        num_dropped=jnp.maximum(found - cells.shape[0], 0),
        status=status.astype(jnp.int32),
    )


@functools.partial(jax.jit, static_argnames=("shape", "batch_size"))
def match_pairs(
    keys: PRNGKey,
    features0: JoinedFeatures,
    features1: JoinedFeatures,
    thresholds: Thresholds,
    *,
    shape: PairShape,
    batch_size: int = 1,
) -> PairMatches:
    """`match_pair` over a leading axis of keys and features.

    Args:
      batch_size: number of pairs that are computed together (vmapped); batches follow each other.
        With 1 the results equal those of `match_pair` bit for bit. With more, products are vmapped
        and may round differently in the last place. On a CPU 1 is best, because one pair fills it,
        and vmapped loops over windows run every pair as long as the slowest one.
    """

    def one(item):
        key, f0, f1 = item
        return match_pair(key, f0, f1, thresholds, shape=shape)

    return one_by_one(one, (keys, features0, features1), batch_size=batch_size)
