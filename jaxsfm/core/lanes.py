"""Loops and conditions that stay loops and conditions under `vmap`.

JAX turns a condition on a vmapped value into a selection: both of its branches are computed, for
every lane and in every turn of the loop around it. A condition on `anywhere` keeps its meaning,
because all lanes share its value: what no lane asks for is not computed. Its branches must then
leave the other lanes as they are.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


@jax.custom_batching.custom_vmap
def anywhere(wanted: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether `wanted` holds in any lane; without `vmap` it is `wanted` itself."""
    return wanted


@anywhere.def_vmap
def _any_lane(lanes: int, batched: list[bool], wanted: Array) -> tuple[Array, bool]:
    del lanes, batched  # without a batched argument this rule is not used
    return anywhere(jnp.any(wanted, axis=0)), False
