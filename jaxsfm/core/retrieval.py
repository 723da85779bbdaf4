"""Retrieval: one global descriptor for a whole image, and which photos are matched with each other.

A global descriptor is made of the image's local ones. Their zero rows are padding, or cells that
show nothing. The order of rows does not matter. VLAD has a vocabulary, fitted on a sample of the
descriptors of a collection: descriptors are projected onto principal directions and whitened, and
k-means gives the centres. Source: Jegou and Chum, ECCV 2012, section 3 (whitening before VLAD).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.numerics import HIGHEST, argmax_first, squared_norm, unit
from jaxsfm.core.types import PRNGKey

LEAST_VARIANCE = 1e-6
"""Directions whose variance, relative to the largest, is below this are dropped, not scaled up."""
TIE = 1e-5
"""Products of global descriptors that differ by less count as equal, so that rounding does not
order them."""


class Vocabulary(NamedTuple):
    """A projection of local descriptors, and the centres that they are compared with."""

    mean: Float[Array, " c"]
    whitening: Float[Array, "c d"]
    centres: Float[Array, "k d"]


def seen(x: Float[Array, "n c"]) -> Bool[Array, " n"]:
    """Which rows are descriptors: zero rows are padding, or cells that show nothing."""
    return jnp.any(x != 0, axis=-1)


def whitened(x: Float[Array, "n c"], words: Vocabulary) -> Float[Array, "n d"]:
    """Unit descriptors in the directions of the vocabulary; zero rows stay zero."""
    flat = jnp.matmul(x - words.mean, words.whitening, precision=HIGHEST)
    return jnp.where(seen(x)[:, None], unit(flat), 0.0)


def nearest_centre(x: Float[Array, "n d"], centres: Float[Array, "k d"]) -> Int[Array, " n"]:
    """The centre nearest to every row; the first one among equals."""
    products = jnp.matmul(x, centres.T, precision=HIGHEST)
    return argmax_first(products - 0.5 * squared_norm(centres), axis=1)[1]


def lloyd(
    x: Float[Array, "n d"], centres: Float[Array, "k d"], *, iterations: int = 25
) -> Float[Array, "k d"]:
    """k-means from given centres. Zero rows of `x` do not count, and a centre without rows stays
    where it is."""
    live = seen(x)

    def step(_, centres):
        own = jax.nn.one_hot(nearest_centre(x, centres), len(centres), dtype=x.dtype)
        own = jnp.where(live[:, None], own, 0.0)
        counts = jnp.sum(own, axis=0)[:, None]
        sums = jnp.matmul(own.T, x, precision=HIGHEST)
        return jnp.where(counts > 0, sums / jnp.maximum(counts, 1.0), centres)

    return lax.fori_loop(0, iterations, step, centres)


def fit_vocabulary(
    key: PRNGKey, sample: Float[Array, "n c"], *, words: int = 64, directions: int = 64
) -> Vocabulary:
    """The vocabulary of a sample of unit descriptors.

    Args:
      key: chooses the descriptors that k-means starts from.
      sample: at least `words` rows; zero rows do not count as descriptors.
      words: number of centres.
      directions: number of principal directions that are kept, at most c.

    Raises:
      ValueError: there are too few rows or channels.
    """
    rows, channels = sample.shape
    if rows < words or channels < directions:
        raise ValueError(
            f"sample must have at least {words} rows of {directions} channels; "
            f"got {rows} of {channels}"
        )
    live = seen(sample)
    number = jnp.maximum(jnp.sum(live), 1).astype(sample.dtype)
    mean = jnp.sum(sample, axis=0) / number
    rest = jnp.where(live[:, None], sample - mean, 0.0)
    variances, axes = jnp.linalg.eigh(jnp.matmul(rest.T, rest, precision=HIGHEST) / number)
    variances, axes = variances[-directions:], axes[:, -directions:]
    large = variances > LEAST_VARIANCE * variances[-1]
    scales = jnp.where(large, lax.rsqrt(jnp.where(large, variances, 1.0)), 0.0)
    made = Vocabulary(mean, axes * scales, jnp.zeros((words, directions), sample.dtype))
    flat = whitened(sample, made)
    # The descriptors come first, in random order, and the zero rows after them.
    order = jnp.argsort(jnp.where(live, jax.random.uniform(key, (rows,), jnp.float32), 1.0))
    return made._replace(centres=lloyd(flat, flat[order[:words]]))


def gem(x: Float[Array, "n c"], *, power: float = 3.0) -> Float[Array, " c"]:
    """The generalised mean of every channel, scaled to unit length. Negative values count as zero.

    Source: Radenovic, Tolias and Chum, TPAMI 2019, equation 3.
    """
    number = jnp.maximum(jnp.sum(seen(x)), 1).astype(x.dtype)
    mean = jnp.sum(jnp.maximum(x, 0.0) ** power, axis=0) / number
    return unit(mean ** (1 / power))


def vlad(x: Float[Array, "n c"], words: Vocabulary) -> Float[Array, " kd"]:
    """For every centre the sum of the differences between its descriptors and itself.

    Each sum is scaled to unit length, and then the whole vector.

    Source: Jegou et al., CVPR 2010, section 3; Arandjelovic and Zisserman, CVPR 2013, section 3.1.
    """
    flat = whitened(x, words)
    own = jax.nn.one_hot(nearest_centre(flat, words.centres), len(words.centres), dtype=x.dtype)
    own = jnp.where(seen(x)[:, None], own, 0.0)
    sums = jnp.matmul(own.T, flat, precision=HIGHEST)
    rest = sums - jnp.sum(own, axis=0)[:, None] * words.centres
    return unit(unit(rest).reshape(-1))


class NetVLADHead(NamedTuple):
    """The parameters in a NetVLAD file (weights_conversion/README.md)."""

    assignment: Float[Array, "c k"]
    centres: Float[Array, "c k"]
    whitening: Float[Array, "ck o"]
    whitening_bias: Float[Array, " o"]


def netvlad(x: Float[Array, "n c"], head: NetVLADHead) -> Float[Array, " o"]:
    """NetVLAD of conv5_3 before its rectifier. The descriptors are scaled to unit length here.

    Source: Arandjelovic et al., CVPR 2016, section 3.1, and their `layerVLAD.m`, `addPCA.m`.
    """
    live = seen(x)
    x = unit(x)
    weights = jax.nn.softmax(jnp.matmul(x, head.assignment, precision=HIGHEST), axis=1)
    weights = jnp.where(live[:, None], weights, 0.0)
    sums = jnp.matmul(x.T, weights, precision=HIGHEST)
    rest = sums - head.centres * jnp.sum(weights, axis=0)
    whole = unit(unit(rest.T).T.reshape(-1))
    return unit(jnp.matmul(whole, head.whitening, precision=HIGHEST) + head.whitening_bias)


def partners(
    x: Float[Array, "n c"],
    *,
    k: int,
    candidates: int,
    group: Int[Array, " n"] | None = None,
    block: int = 256,
) -> Int[Array, "n k"]:
    """For each row k rows of other groups with large products, which differ from each other.

    The candidates of a row are the rows with the largest products with it. They are taken in this
    order, without those that have a larger product with a taken one than with the row itself. If
    fewer than k are left, the largest of the others follow. So k candidates are all partners. The
    lower index comes first among equals.

    In a video, the nearest rows are neighbours in time, and those are neighbours of each other.
    Source of the rule: Malkov and Yashunin, TPAMI 2020, algorithm 4 (there it keeps a graph of
    neighbours connected across clusters).

    Args:
      x: global descriptors of unit length.
      candidates: their number for each row. If there are fewer other rows, those are taken.
      group: of each row; None: each is one by itself. Where a row has fewer than k rows of other
        groups, rows of its own follow, and it may be among them.
      block: so many rows of the table of products exist at a time.

    Raises:
      ValueError: there are fewer than k other rows, or fewer than k candidates.
    """
    n = x.shape[0]
    if not 1 <= k < n:
        raise ValueError(f"k must lie in 1..{n - 1}, the number of other rows; got {k}")
    if candidates < k:
        raise ValueError(f"candidates must be at least k = {k}; got {candidates}")
    candidates, block = min(candidates, n - 1), min(block, n)
    group = jnp.arange(n, dtype=jnp.int32) if group is None else group
    padded = jnp.pad(x, ((0, -n % block), (0, 0)))

    def rows(start):
        own = lax.dynamic_slice_in_dim(padded, start, block)
        products = jnp.round(jnp.matmul(own, x.T, precision=HIGHEST) / TIE)
        itself = start + jnp.arange(block, dtype=jnp.int32)
        others = jnp.take(group, itself, mode="clip")[:, None] != group
        return lax.top_k(jnp.where(others, products, -jnp.inf), candidates)

    def chosen(row):
        products, at = row
        near = x[at]
        mutual = jnp.round(jnp.matmul(near, near.T, precision=HIGHEST) / TIE)
        taken = _differing(products, mutual)
        return at[jnp.argsort(~taken, stable=True)[:k]]

    starts = jnp.arange(-(-n // block), dtype=jnp.int32) * block
    products, at = (each.reshape(-1, candidates)[:n] for each in lax.map(rows, starts))
    return lax.map(chosen, (products, at)).astype(jnp.int32)


def _differing(products: Float[Array, " m"], mutual: Float[Array, "m m"]) -> Bool[Array, " m"]:
    """The candidates that are not nearer to one that is taken before them than to the row itself.

    Args:
      products: of the candidates with the row, largest first.
      mutual: products of the candidates with each other.
    """

    def step(taken, each):
        i, product, others = each
        fits = ~jnp.any(taken & (others > product))
        return taken.at[i].set(fits), None

    ranks = jnp.arange(len(products), dtype=jnp.int32)
    none = jnp.zeros(len(products), bool)
    return lax.scan(step, none, (ranks, products, mutual))[0]
