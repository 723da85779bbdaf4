"""The rates of the machine, which the stages are compared with."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxsfm.bench.speed.timing import Metric, median, seconds
from jaxsfm.core.numerics import descriptor_products
from jaxsfm.core.pair_shape import Products
from jaxsfm.io.libraries import usable_cores

SIDE = 3072
STREAM_ENTRIES = 1 << 26


@jax.jit
def _product(a, b):
    return descriptor_products("ij,jk->ik", a, b)


class MatrixProduct(NamedTuple):
    """A matrix product that is ready to be computed."""

    compute: Callable[[], jax.Array]
    operations: float


def matrix_product(side: int = SIDE, numbers: Products = "float32") -> MatrixProduct:
    """The product of two square matrices of these numbers, summed in float32."""
    a = jax.random.normal(jax.random.key(0), (side, side)).astype(numbers)
    return MatrixProduct(lambda: _product(a, a), 2.0 * side**3)


@jax.jit
def add_one(a: jax.Array) -> jax.Array:
    """Reads and writes every entry of an array once."""
    return a + 1


def measure() -> Iterator[Metric]:
    """Cores, speed of matrix products, and bandwidth of the memory."""
    a = jnp.zeros(STREAM_ENTRIES, jnp.float32)
    product = matrix_product()
    times, stream = seconds(product.compute, lambda: add_one(a))
    yield Metric("machine.cores", usable_cores(), "", "higher")
    rate = product.operations / median(times)
    yield Metric("machine.matrix_products", rate / 1e9, "GFLOP/s", "higher")
    yield Metric("machine.memory", 2 * a.nbytes / median(stream) / 1e9, "GB/s", "higher")
