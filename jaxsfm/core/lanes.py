"""Batches by `vmap`, so that they cost what their items cost one by one.

A vmapped loop runs every lane as long as the slowest one needs. An accelerator, which one lane does
not fill, gains more from the batch than it loses by that. A CPU is filled by one lane, so it
computes the lanes in turn (`in_turn_on_cpus`).
"""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
from jax import lax

T = TypeVar("T")


def in_turn_on_cpus(function: Callable[..., T]) -> Callable[..., T]:
    """`function`, whose vmapped lanes follow each other on CPUs and run together elsewhere.

    Without `vmap` it is `function`. On CPUs a lane of a batch is computed by the program of a
    single item, so its result is that of the item bit for bit. Arguments are positional and are
    arrays or trees of arrays.
    """

    @jax.custom_batching.custom_vmap
    def single(*args):
        return function(*args)

    @single.def_vmap
    def batch(lanes, batched, *args):
        del lanes
        leaves, tree = jax.tree.flatten(args)
        axes = [0 if b else None for b in jax.tree.leaves(batched)]

        def in_turn(*leaves):
            def lane(some):
                rest = iter(some)
                each = [next(rest) if b == 0 else x for b, x in zip(axes, leaves, strict=True)]
                return single(*tree.unflatten(each))

            return lax.map(lane, [x for b, x in zip(axes, leaves, strict=True) if b == 0])

        def together(*leaves):
            return jax.vmap(lambda *each: function(*tree.unflatten(each)), in_axes=axes)(*leaves)

        found = lax.platform_dependent(*leaves, cpu=in_turn, default=together)
        return found, jax.tree.map(lambda _: True, found)

    return functools.wraps(function)(single)
