"""The rates of the machine, which the stages are compared with."""

import os
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp

from jaxsfm.bench.speed.timing import Metric, median, seconds
from jaxsfm.core.numerics import HIGHEST

SIDE = 3072
MATMUL_FLOP = 2 * SIDE**3
STREAM_ENTRIES = 1 << 26


@jax.jit
def _product(a, b):
    return jnp.matmul(a, b, precision=HIGHEST)


def matrix_product() -> Callable[[], jax.Array]:
    """A function that computes a float32 product of `MATMUL_FLOP` operations."""
    a = jax.random.normal(jax.random.key(0), (SIDE, SIDE))
    return lambda: _product(a, a)


@jax.jit
def add_one(a: jax.Array) -> jax.Array:
    """Reads and writes every entry of an array once."""
    return a + 1


def measure() -> Iterator[Metric]:
    """Cores, speed of matrix products, and bandwidth of the memory."""
    a = jnp.zeros(STREAM_ENTRIES, jnp.float32)
    product, stream = seconds(matrix_product(), lambda: add_one(a))
    yield Metric("machine.cores", len(os.sched_getaffinity(0)), "", "higher")
    yield Metric(
        "machine.matrix_products", MATMUL_FLOP / median(product) / 1e9, "GFLOP/s", "higher"
    )
    yield Metric("machine.memory", 2 * a.nbytes / median(stream) / 1e9, "GB/s", "higher")
