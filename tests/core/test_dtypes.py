"""Laws of types and precision that hold for every public function of the core."""

import functools
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_calls import WITHOUT_ARRAYS, calls, public_functions
from jax.extend import core as jex

CALLS = calls()
EVERY = pytest.mark.parametrize("name", CALLS)
PRODUCTS = {"dot_general", "conv_general_dilated", "ragged_dot"}


def equations(jaxpr) -> Iterator:
    """All equations of a program, those of its loops and branches too."""
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for part in jax.tree.leaves(value, is_leaf=lambda x: hasattr(x, "eqns")):
                if isinstance(part, jex.ClosedJaxpr):
                    yield from equations(part.jaxpr)
                elif isinstance(part, jex.Jaxpr):
                    yield from equations(part)


@functools.cache
def program(name: str, *, x64: bool = False) -> tuple[list, list]:
    """The equations of a call, and the types of its results. It is traced once for all laws."""
    call = CALLS[name]
    with jax.enable_x64(x64):
        traced, results = jax.make_jaxpr(call.function, return_shape=True)(*call.args)
    return list(equations(traced.jaxpr)), types(results)


def types(tree) -> list:
    return [leaf.dtype for leaf in jax.tree.leaves(tree)]


def test_every_public_function_that_computes_arrays_is_called_here():
    called = {name.partition("[")[0] for name in CALLS}
    assert public_functions() - called == WITHOUT_ARRAYS


@EVERY
def test_nothing_is_computed_in_64_bits_where_jax_has_64_bits(name):
    """The results have the same types, and no floating point number on the way has 64 bits.

    Numbers of Python (weak types) do not count: they take the type of what they meet.
    """
    computed, results = program(name, x64=True)
    assert results == program(name)[1]
    for equation in computed:
        for out in equation.outvars:
            wide = getattr(out.aval, "dtype", None) in (jnp.float64, jnp.complex128)
            assert not wide or out.aval.weak_type, equation


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(k, marks=[pytest.mark.slow, pytest.mark.optimized] if call.slow else [])
        for k, call in CALLS.items()
        if not call.traced
    ],
)
def test_values_are_the_same_bit_for_bit_where_jax_has_64_bits(name):
    call = CALLS[name]
    results = []
    for x64 in (False, True):
        with jax.enable_x64(x64):
            results.append(jax.device_get(jax.jit(call.function)(*call.args)))
    jax.tree.map(np.testing.assert_array_equal, *results)


def in_bfloat16(features):
    """Features with floating point numbers of 16 bits; keypoints stay as they are."""
    low = jax.tree.map(lambda x: x.astype(jnp.bfloat16) if x.dtype == np.float32 else x, features)
    return low._replace(keypoints=features.keypoints) if hasattr(low, "keypoints") else low


@pytest.mark.parametrize("name", [k for k, call in CALLS.items() if call.coordinates])
def test_coordinates_are_float32_also_where_features_are_bfloat16(name):
    call = CALLS[name]
    low = [in_bfloat16(x) if k in call.features else x for k, x in enumerate(call.args)]
    for found in (program(name)[1], types(jax.eval_shape(call.function, *low))):
        assert {found[k] for k in call.coordinates} == {np.dtype(np.float32)}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [k for k, c in CALLS.items() if c.coordinates and c.features and not c.slow | c.traced]
)
def test_coordinates_of_bfloat16_features_are_those_of_the_same_numbers_in_float32(name):
    call = CALLS[name]
    low = [in_bfloat16(x) if k in call.features else x for k, x in enumerate(call.args)]
    high = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == jnp.bfloat16 else x, low)
    ours, expected = (jax.tree.leaves(jax.jit(call.function)(*args)) for args in (low, high))
    for k in call.coordinates:
        np.testing.assert_allclose(ours[k], expected[k], rtol=1e-6)


@EVERY
def test_every_product_states_its_precision(name):
    for equation in program(name)[0]:
        if equation.primitive.name in PRODUCTS:
            assert equation.params["precision"] is not None, equation


X64_MODULES = ("coarse_to_fine", "matching", "lanes", "products")


@pytest.mark.slow
def test_the_laws_of_matching_hold_where_jax_has_64_bits():
    """The tests of some modules, in a process that is started with JAX_ENABLE_X64=1."""
    here = Path(__file__).parent
    modules = [str(here / f"test_{name}.py") for name in X64_MODULES]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *modules]
    done = subprocess.run(
        command, env=os.environ | {"JAX_ENABLE_X64": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-3000:]
