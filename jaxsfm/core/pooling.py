"""Global descriptors: one descriptor for a whole image, made of its local ones.

Zero rows of local descriptors are padding, or cells that show nothing. The order of rows does not
matter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsfm.core.numerics import HIGHEST, unit
from jaxsfm.core.vocabulary import Vocabulary, nearest_centre, seen, whitened


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
