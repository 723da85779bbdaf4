"""A vocabulary for VLAD, fitted on a sample of the descriptors of a collection.

Descriptors are projected onto principal directions and whitened; k-means gives the centres.

Source: Jegou and Chum, ECCV 2012, section 3 (whitening before VLAD).
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
