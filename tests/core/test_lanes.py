"""Laws of lanes that take turns."""

import jax
import jax.numpy as jnp
import numpy as np
from compiled import compiled
from jax import lax

from jaxsfm.core.lanes import in_turn_on_cpus


def counted(calls):
    """A function that notes that it was computed, and adds one."""

    def function(x):
        jax.debug.callback(lambda: calls.append(1))
        return x + 1

    return function


def test_lanes_in_turn_are_the_function_with_and_without_batched_arguments():
    """Trees of arguments and results, keys, and vmaps in vmaps."""

    def draw(key, scale, pair):
        return {"x": scale * jax.random.uniform(key, (3,), jnp.float32) + pair[0], "y": pair[1]}

    in_turn = in_turn_on_cpus(draw)
    keys = jax.random.split(jax.random.key(0), 6).reshape(2, 3)
    pair = np.arange(6, dtype=np.float32).reshape(2, 3), np.float32(7)
    axes = 0, None, (0, None)
    for vmapped in (jax.vmap, lambda f, axes: jax.vmap(jax.vmap(f, axes), axes)):
        some = (keys, pair) if vmapped is not jax.vmap else (keys[0], (pair[0][0], pair[1]))
        ours, theirs = (
            compiled(vmapped(f, axes))(some[0], np.float32(2), some[1]) for f in (in_turn, draw)
        )
        for name in ("x", "y"):
            np.testing.assert_array_equal(ours[name], theirs[name])


def test_on_a_cpu_each_lane_of_a_loop_takes_its_own_turns_only():
    calls: list[int] = []
    add = counted(calls)

    def count_to(end):
        return lax.while_loop(lambda x: x < end, add, jnp.int32(0))

    ends = np.int32([1, 6, 0])
    found = jax.jit(jax.vmap(in_turn_on_cpus(count_to)))(ends)
    jax.effects_barrier()
    np.testing.assert_array_equal(found, ends)
    assert len(calls) == 7
