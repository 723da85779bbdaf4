"""One descriptor for a whole image out of its local ones, and the nearest of them.

All zero rows of local descriptors are padding, or show nothing; their order does not matter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsfm.core.numerics import HIGHEST, unit
from jaxsfm.core.vocabulary import Vocabulary, nearest_centre, seen, whitened

TIE = 1e-5
"""Products of global descriptors closer than this are equal: rounding must not order them."""


def gem(x: Float[Array, "n c"], *, power: float = 3.0) -> Float[Array, " c"]:
    """Generalised mean of every channel, then unit length; negative values count as zero.

    Source: Radenovic, Tolias and Chum, TPAMI 2019, equation 3.
    """
    number = jnp.maximum(jnp.sum(seen(x)), 1).astype(x.dtype)
    mean = jnp.sum(jnp.maximum(x, 0.0) ** power, axis=0) / number
    return unit(mean ** (1 / power))


def vlad(x: Float[Array, "n c"], words: Vocabulary) -> Float[Array, " kd"]:
    """Sums of what separates descriptors from their centres: each centre's, then the whole, of
    unit length.

    Source: Jegou et al., CVPR 2010, section 3; Arandjelovic and Zisserman, CVPR 2013, section 3.1.
    """
    flat = whitened(x, words)
    own = jax.nn.one_hot(nearest_centre(flat, words.centres), len(words.centres), dtype=x.dtype)
    own = jnp.where(seen(x)[:, None], own, 0.0)
    sums = jnp.matmul(own.T, flat, precision=HIGHEST)
    rest = sums - jnp.sum(own, axis=0)[:, None] * words.centres
    return unit(unit(rest).reshape(-1))


class NetVLADHead(NamedTuple):
    """Of a NetVLAD file (weights_conversion/README.md)."""

    assignment: Float[Array, "c k"]
    centres: Float[Array, "c k"]
    whitening: Float[Array, "ck o"]
    whitening_bias: Float[Array, " o"]


def netvlad(x: Float[Array, "n c"], head: NetVLADHead) -> Float[Array, " o"]:
    """NetVLAD of conv5_3 before its rectifier; the descriptors get unit length here.

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


def nearest(x: Float[Array, "n c"], *, k: int, block: int = 256) -> Int[Array, "n k"]:
    """The k other rows of largest product with each row, best first; ties by the lower index.

    `block` rows of the table of products exist at a time.

    Raises:
      ValueError: there are no k other rows.
    """
    n = x.shape[0]
    if not 1 <= k < n:
        raise ValueError(f"k must lie in 1..{n - 1}, the number of other rows; got {k}")
    block = min(block, n)
    padded = jnp.pad(x, ((0, -n % block), (0, 0)))

    def rows(start):
        own = lax.dynamic_slice_in_dim(padded, start, block)
        products = jnp.round(jnp.matmul(own, x.T, precision=HIGHEST) / TIE)
        itself = start + jnp.arange(block, dtype=jnp.int32)
        others = itself[:, None] != jnp.arange(n, dtype=jnp.int32)
        return lax.top_k(jnp.where(others, products, -jnp.inf), k)[1]

    starts = jnp.arange(-(-n // block), dtype=jnp.int32) * block
    return lax.map(rows, starts).reshape(-1, k)[:n].astype(jnp.int32)
