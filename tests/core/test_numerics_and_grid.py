"""Laws of the small pieces: pixel convention, unit vectors, argmax, compaction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import rng_of, seeds
from tolerances import GRADIENT, UNIT

from jaxsfm.core import grid, numerics

cell_to_px = compiled(grid.cell_to_px, "stride")
unit, across = compiled(numerics.unit), compiled(numerics.across)
argmax_first = compiled(numerics.argmax_first, "axis")
compact = compiled(numerics.compact, "size")


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 200), st.integers(0, 200), st.sampled_from([1, 2, 8, 16]))
def test_a_cells_centre_is_the_mean_of_its_pixels(u, v, stride):
    x = np.arange(stride * u, stride * (u + 1)).mean()
    y = np.arange(stride * v, stride * (v + 1)).mean()
    np.testing.assert_allclose(cell_to_px(np.float32([[u, v]]), stride=stride)[0], [x, y])


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from([1e-12, 1e-3, 1.0, 1e6]))
def test_unit_rows_have_norm_one(seed, size):
    x = (rng_of(seed).normal(size=(5, 8)) * size).astype(np.float32)
    np.testing.assert_allclose(np.linalg.norm(unit(x), axis=1), 1.0, **UNIT)


@settings(max_examples=20, deadline=None)
@given(seeds, st.integers(2, 5))
def test_columns_across_a_unit_vector_complete_it_to_an_orthonormal_basis(seed, n):
    x = unit(np.float32(rng_of(seed).normal(size=n)))
    basis = np.column_stack([x, across(x)])
    np.testing.assert_allclose(basis.T @ basis, np.eye(n), atol=1e-5)


def test_the_unit_of_zero_is_zero_with_a_finite_gradient():
    zero = np.zeros((2, 4), np.float32)
    np.testing.assert_array_equal(unit(zero), zero)
    assert np.isfinite(compiled(jax.grad(lambda x: numerics.unit(x).sum()))(zero)).all()


def test_the_gradient_of_unit_is_that_of_finite_differences():
    x, weight = np.float32([[0.5, -1.0, 2.0]]), np.float32([1.0, 2.0, -1.0])
    f = compiled(jax.value_and_grad(lambda x: (numerics.unit(x) * weight[None]).sum()))
    steps = np.float32(1e-2) * np.eye(3, dtype=np.float32)[:, None]
    numeric = [(f(x + step)[0] - f(x - step)[0]) / 2e-2 for step in steps]
    np.testing.assert_allclose(f(x)[1][0], numeric, **GRADIENT)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_argmax_first_is_numpys_argmax(seed):
    x = rng_of(seed).integers(0, 4, (6, 9)).astype(np.float32)  # many ties
    for axis in (0, 1):
        best, index = argmax_first(x, axis=axis)
        np.testing.assert_array_equal(best, x.max(axis))
        np.testing.assert_array_equal(index, x.argmax(axis))


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from([3, 12]))
def test_compaction_lists_the_set_entries_in_order(seed, size):
    mask = rng_of(seed).random(12) < 0.4
    index, count = compact(mask, size=size)
    expected = np.flatnonzero(mask)
    assert count == len(expected)
    np.testing.assert_array_equal(index[: min(size, len(expected))], expected[:size])


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("batch_size", [1, 3, 8])
def test_a_batch_is_its_items_and_one_batch_is_no_loop(count, batch_size):
    rows = np.arange(3 * count, dtype=np.float32).reshape(count, 3)
    items = rows, np.arange(count, dtype=np.int32)

    def one(item):
        return {"sum": item[0].sum() * item[1].astype(jnp.float32), "row": item[0]}

    def run(items):
        return numerics.one_by_one(one, items, batch_size=batch_size)

    made = compiled(run)(items)
    np.testing.assert_array_equal(made["row"], items[0])
    np.testing.assert_array_equal(made["sum"], rows.sum(1) * np.arange(count))
    assert ("scan" in str(jax.make_jaxpr(run)(items))) == (count > batch_size)
