"""Laws of conditions and loops that all lanes of a batch share."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxsfm.core.lanes import anywhere


def counted(calls):
    """A function that notes that it was computed, and adds one."""

    def function(x):
        jax.debug.callback(lambda: calls.append(1))
        return x + 1

    return function


def test_it_is_its_argument_for_one_and_any_for_a_batch():
    for wanted in (False, True):
        assert bool(anywhere(jnp.bool_(wanted))) == wanted
    table = np.asarray([[False, False], [False, True], [True, True]])
    seen = jax.vmap(lambda x: anywhere(x))(jnp.asarray(table[:, 0]))
    assert seen.tolist() == [True] * 3
    seen = jax.vmap(jax.vmap(anywhere))(jnp.asarray(table[:2] & False))
    assert not np.asarray(seen).any()
    assert np.asarray(jax.vmap(jax.vmap(anywhere))(jnp.asarray(table))).all()


@pytest.mark.parametrize("wanted", [[False] * 3, [False, True, False]])
def test_a_branch_that_no_lane_wants_is_not_computed(wanted):
    calls: list[int] = []
    add = counted(calls)

    def one(x, w):
        return lax.cond(anywhere(w), lambda: jnp.where(w, add(x), x), lambda: x)

    found = jax.jit(jax.vmap(one))(jnp.arange(3), jnp.asarray(wanted))
    jax.effects_barrier()
    np.testing.assert_array_equal(found, np.arange(3) + np.asarray(wanted))
    assert bool(calls) == any(wanted)


def test_a_loop_ends_with_its_last_lane_and_its_counter_is_shared():
    def one(end):
        def body(state):
            turn, total = state
            return turn + 1, total + jnp.where(turn < end, turn, 0)

        start = (jnp.int32(0), jnp.int32(0))
        return lax.while_loop(lambda s: anywhere(s[0] < end), body, start)

    ends = np.asarray([0, 5, 3])
    turns, totals = jax.jit(jax.vmap(one, out_axes=(None, 0)))(jnp.asarray(ends))
    assert turns == 5
    np.testing.assert_array_equal(totals, [sum(range(e)) for e in ends])
