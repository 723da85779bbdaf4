"""Coarse-to-fine matching down to single pixels: the alternative that the paper argues against.

Each match of two fine cells is followed down the pyramid in both images at once. At every level the
most similar pair of children takes its place. This needs the descriptors of all levels of both
images. The keypoint of a cell differs from pair to pair, so tracks break, while relocalization
(`jaxsfm.core.relocalize`) finds it in one image alone (paper, section 3.2).
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsfm.core import coarse_to_fine as c2f
from jaxsfm.core.matching import mutual_nn
from jaxsfm.core.numerics import HIGHEST, unit
from jaxsfm.core.pair import pair_matches, tentative_matches
from jaxsfm.core.pair_shape import PairShape
from jaxsfm.core.ransac import peel_planes
from jaxsfm.core.types import JoinedFeatures, PairMatches, PRNGKey, Thresholds

Maps = Sequence[Float[Array, "_h _w _c"]]
"""Feature maps of one image, coarse to fine, each twice the size of the last."""
_CHILDREN = ((0, 0), (0, 1), (1, 0), (1, 1))


def descend(
    maps0: Maps, maps1: Maps, cells0: Int[Array, "k 2"], cells1: Int[Array, "k 2"]
) -> tuple[Int[Array, "k 2"], Int[Array, "k 2"]]:
    """The cells (row, column) of the finest maps to which matches are followed.

    Args:
      maps0, maps1: not normalised; the first map is twice the size of the one that the cells
        belong to.
      cells0, cells1: the matched cells (row, column).
    """
    steps = jnp.asarray(_CHILDREN, jnp.int32)
    for level0, level1 in zip(maps0, maps1, strict=True):
        children0, children1 = (2 * cells[:, None] + steps for cells in (cells0, cells1))
        a, b = (
            unit(level[children[..., 0], children[..., 1]])
            for level, children in ((level0, children0), (level1, children1))
        )
        similarity = jnp.einsum("kic,kjc->kij", a, b, precision=HIGHEST)
        best = jnp.argmax(similarity.reshape(len(similarity), -1), axis=1).astype(jnp.int32)
        pick = jnp.arange(len(best), dtype=jnp.int32)
        cells0, cells1 = children0[pick, best // 4], children1[pick, best % 4]
    return cells0, cells1


@functools.partial(jax.jit, static_argnames=("shape",))
def match_naively(
    key: PRNGKey,
    features: tuple[JoinedFeatures, JoinedFeatures],
    maps: tuple[Maps, Maps],
    thresholds: Thresholds,
    *,
    shape: PairShape,
) -> PairMatches:
    """Verified matches of pixels, of which the fine cells are one to one.

    Coarse matches have no votes, and the first of several matches of a cell survives.

    Returns:
      As `jaxsfm.core.pair.match_pair` does, but `cells` are the indices row * columns + column of
      pixels in the finest maps.
    """
    f0, f1 = features
    coarse = mutual_nn(f0.coarse, f1.coarse, tile=shape.coarse_tile)
    fine, found = tentative_matches(f0, f1, coarse, shape=shape)
    ends = descend(
        *maps,
        *(
            jnp.stack(jnp.divmod(fine[:, side], f.fine_grid[1]), axis=1)
            for side, f in enumerate(features)
        ),
    )
    xy0, xy1 = (end[:, ::-1].astype(jnp.float32) for end in ends)
    valid = jnp.arange(len(fine), dtype=jnp.int32) < found
    planes = peel_planes(key, xy0, xy1, valid, thresholds, shape=shape)
    equal = jnp.zeros((len(fine),), jnp.float32)
    num_fine = max(f0.fine.shape[0], f1.fine.shape[0])
    kept = c2f.one_to_one(fine, planes.plane >= 0, equal, num_cells=num_fine)
    planes = planes._replace(plane=jnp.where(kept, planes.plane, -1))
    pixels = [end[:, 0] * own[-1].shape[1] + end[:, 1] for end, own in zip(ends, maps, strict=True)]
    return pair_matches(coarse, jnp.stack(pixels, axis=1), found, planes, thresholds)
