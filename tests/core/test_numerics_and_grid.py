"""Laws of the small pieces: pixel convention, unit vectors, argmax, compaction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import rng_of, seeds
from tolerances import GRADIENT, UNIT

from jaxsfm.core import grid, numerics


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 200), st.integers(0, 200), st.sampled_from([1, 2, 8, 16]))
def test_a_cells_centre_is_the_mean_of_its_pixels(u, v, stride):
    x = np.arange(stride * u, stride * (u + 1)).mean()
    y = np.arange(stride * v, stride * (v + 1)).mean()
    cell = jnp.asarray([[u, v]], jnp.float32)
    np.testing.assert_allclose(grid.cell_to_px(cell, stride=stride)[0], [x, y])


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from([1e-12, 1e-3, 1.0, 1e6]))
def test_unit_rows_have_norm_one(seed, size):
    x = (rng_of(seed).normal(size=(5, 8)) * size).astype(np.float32)
    np.testing.assert_allclose(np.linalg.norm(numerics.unit(jnp.asarray(x)), axis=1), 1.0, **UNIT)


@settings(max_examples=20, deadline=None)
@given(seeds, st.integers(2, 5))
def test_columns_across_a_unit_vector_complete_it_to_an_orthonormal_basis(seed, n):
    x = numerics.unit(jnp.asarray(rng_of(seed).normal(size=n), jnp.float32))
    basis = np.column_stack([x, numerics.across(x)])
    np.testing.assert_allclose(basis.T @ basis, np.eye(n), atol=1e-5)


def test_the_unit_of_zero_is_zero_with_a_finite_gradient():
    zero = jnp.zeros((2, 4), jnp.float32)
    np.testing.assert_array_equal(numerics.unit(zero), zero)
    assert np.isfinite(jax.grad(lambda x: numerics.unit(x).sum())(zero)).all()


def test_the_gradient_of_unit_is_that_of_finite_differences():
    x = jnp.asarray([[0.5, -1.0, 2.0]], jnp.float32)
    weight = jnp.asarray([1.0, 2.0, -1.0], jnp.float32)
    f = lambda x: (numerics.unit(x) * weight[None]).sum()  # noqa: E731
    step = 1e-2
    numeric = [(f(x.at[0, i].add(step)) - f(x.at[0, i].add(-step))) / (2 * step) for i in range(3)]
    np.testing.assert_allclose(jax.grad(f)(x)[0], numeric, **GRADIENT)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_argmax_first_is_numpys_argmax(seed):
    x = rng_of(seed).integers(0, 4, (6, 9)).astype(np.float32)  # many ties
    for axis in (0, 1):
        best, index = numerics.argmax_first(jnp.asarray(x), axis=axis)
        np.testing.assert_array_equal(best, x.max(axis))
        np.testing.assert_array_equal(index, x.argmax(axis))


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from([3, 12]))
def test_compaction_lists_the_set_entries_in_order(seed, size):
    mask = rng_of(seed).random(12) < 0.4
    index, count = numerics.compact(jnp.asarray(mask), size=size)
    expected = np.flatnonzero(mask)
    assert count == len(expected)
    np.testing.assert_array_equal(index[: min(size, len(expected))], expected[:size])


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("batch_size", [1, 3, 8])
def test_a_batch_is_its_items_and_one_batch_is_no_loop(count, batch_size):
    rows = jnp.arange(3 * count, dtype=jnp.float32).reshape(count, 3)
    items = rows, jnp.arange(count, dtype=jnp.int32)

    def one(item):
        return {"sum": item[0].sum() * item[1].astype(jnp.float32), "row": item[0]}

    def run(items):
        return numerics.one_by_one(one, items, batch_size=batch_size)

    made = run(items)
    np.testing.assert_array_equal(made["row"], items[0])
    np.testing.assert_array_equal(made["sum"], np.asarray(items[0]).sum(1) * np.arange(count))
    assert ("scan" in str(jax.make_jaxpr(run)(items))) == (count > batch_size)
