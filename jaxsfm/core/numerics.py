"""Small functions that all stages share, written with care for rounding and gradients."""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

HIGHEST = lax.Precision.HIGHEST
"""GPUs may round float32 products to TF32 (10 bits): at 1600 px that is 1.5 px. Every product
that decides geometry or a nearest neighbour states this precision."""


def at_least_float32(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """float16 and bfloat16 as float32; float32 and float64 stay as they are.

    bfloat16 has 8 binary digits, so that coordinates of a thousand pixels would be multiples of 4.
    """
    return x.astype(jnp.float32) if jnp.finfo(x.dtype).bits < 32 else x


def descriptor_products(
    subscripts: str, a: Float[Array, "*a"], b: Float[Array, "*b"]
) -> Float[Array, "*ab"]:
    """`einsum` of two arrays of descriptors, summed in float32, or in float64 if they have 64 bits.

    Descriptors of 16 bits are multiplied as they are on accelerators. CPUs convert them to float32
    first. Both multiply the same numbers: the product of two numbers of 16 bits has at most 22
    binary digits, so float32 holds it exactly. Only the order of the sums differs.
    """
    converted = functools.partial(_converted_products, subscripts)
    if a.dtype != b.dtype or a.dtype.itemsize > 2:
        return converted(a, b)
    as_they_are = functools.partial(_products_of_16_bits, subscripts)
    return lax.platform_dependent(a, b, cpu=converted, default=as_they_are)


def _converted_products(subscripts: str, a: Array, b: Array) -> Array:
    a, b = at_least_float32(a), at_least_float32(b)
    return jnp.einsum(subscripts, a, b, precision=HIGHEST)


def _products_of_16_bits(subscripts: str, a: Array, b: Array) -> Array:
    return jnp.einsum(subscripts, a, b, precision=HIGHEST, preferred_element_type=jnp.float32)


def squared_norm(x: Float[Array, "*batch c"]) -> Float[Array, "*batch"]:
    """Sum of squares over the last axis."""
    return jnp.sum(x * x, axis=-1)


def inverse_norm(x: Float[Array, "*batch c"]) -> Float[Array, "*batch"]:
    """1 / L2 norm over the last axis; 0 for an all-zero vector, with a finite gradient.

    The unused branch is made safe before `where`; otherwise its gradient would be NaN.
    """
    square = squared_norm(x)
    safe = jnp.where(square > 0, square, 1.0)
    return jnp.where(square > 0, lax.rsqrt(safe), 0.0)


def unit(x: Float[Array, "*batch c"]) -> Float[Array, "*batch c"]:
    """L2-normalise the last axis; an all-zero vector stays zero and has a finite gradient."""
    return x * inverse_norm(x)[..., None]


def across(x: Float[Array, " n"]) -> Float[Array, "n m"]:
    """n - 1 columns at right angles to a unit vector and to each other: those of the reflection
    that maps the vector to the last axis or to its opposite (Householder's)."""
    v = x.at[-1].add(jnp.where(x[-1] >= 0, 1.0, -1.0).astype(x.dtype))
    return (jnp.eye(len(x), dtype=x.dtype) - 2 * v[:, None] * v / jnp.sum(v**2))[:, :-1]


def argmax_first(x: Float[Array, "*shape"], *, axis: int) -> tuple[Array, Array]:
    """The maximum along an axis, and the lowest index that reaches it.

    These are two vectorised reductions. A single reduction of (value, index) is compiled to scalar
    code on CPUs.
    """
    best = jnp.max(x, axis=axis)
    index = lax.broadcasted_iota(jnp.int32, x.shape, axis)
    where = jnp.where(x == jnp.expand_dims(best, axis), index, x.shape[axis])
    return best, jnp.min(where, axis=axis)


def compact(mask: Bool[Array, " k"], *, size: int) -> tuple[Int[Array, " size"], Int[Array, ""]]:
    """Indices of the set entries in order, padded with 0, and how many there are."""
    return jnp.nonzero(mask, size=size, fill_value=0)[0].astype(jnp.int32), mask.sum(
        dtype=jnp.int32
    )


Item = TypeVar("Item")
Result = TypeVar("Result")


def one_by_one(function: Callable[[Item], Result], items: Item, *, batch_size: int) -> Result:
    """`function` over the leading axis of the arrays in `items`, `batch_size` vmapped at a time.

    A single item is not computed in a loop, so that XLA compiles what it compiles without a batch.
    """
    if jax.tree.leaves(items)[0].shape[0] == 1:
        result = function(jax.tree.map(lambda x: x[0], items))
        return jax.tree.map(lambda x: x[None], result)
    return lax.map(function, items, batch_size=batch_size if batch_size > 1 else None)
