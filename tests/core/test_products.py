"""Laws of descriptors of 16 bits: they are rounded once, and nothing else changes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled
from core_calls import calls
from strategies import rng_of, unit_rows
from tolerances import UNIT

from jaxsfm.core import numerics
from jaxsfm.core.matching import mutual_nn
from jaxsfm.core.octaves import join_octaves

match = compiled(mutual_nn)
HALVES = pytest.mark.parametrize("products", ["float16", "bfloat16"])


@HALVES
@pytest.mark.parametrize("way", ["_converted_products", "_products_of_16_bits"])
def test_products_of_16_bits_are_those_of_the_same_numbers_in_float64(products, way):
    """On CPUs and elsewhere: they are summed in float32, and not in 16 bits."""
    a, b = (unit_rows(rng_of(k), 30, 512).astype(getattr(jnp, products)) for k in (0, 1))
    found = compiled(functools.partial(getattr(numerics, way), "nc,mc->nm"))(a, b)
    assert found.dtype == jnp.float32
    exact = np.asarray(a, np.float64) @ np.asarray(b, np.float64).T
    np.testing.assert_allclose(found, exact, **UNIT)


@HALVES
def test_joined_descriptors_are_rounded_once_and_keypoints_are_not(products):
    (dense,) = calls()["octaves.join_octaves"].args
    rounded, exact = (
        compiled(functools.partial(join_octaves, products=p))(dense) for p in (products, "float32")
    )
    half = getattr(jnp, products)
    expected = exact._replace(
        coarse=exact.coarse.astype(half),
        fine=exact.fine.astype(half),
        coarse_parts=tuple(p._replace(flat=p.flat.astype(half)) for p in exact.coarse_parts),
    )
    jax.tree.map(np.testing.assert_array_equal, rounded, expected)
    assert rounded.keypoints.dtype == jnp.float32
    assert {x.dtype.name for x in (rounded.coarse, rounded.fine)} == {products}


@HALVES
def test_matches_of_16_bits_are_those_of_the_rounded_numbers(products):
    rng = rng_of(3)
    a = unit_rows(rng, 60, 64)
    b = a[rng.permutation(60)] + 0.1 * unit_rows(rng, 60, 64)
    low = [np.float32(x).astype(getattr(jnp, products)) for x in (a, b)]
    expected = match(*(x.astype(np.float32) for x in low))
    assert (expected >= 0).sum() > 50
    np.testing.assert_array_equal(match(*low), expected)
