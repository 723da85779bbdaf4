"""Templates that stay on the device from where they are made to where they are used."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsfm.core.align import Templates
from jaxsfm.sfm.refine.padding import largest_chunk


class DeviceTemplates:
    """The templates of some of the points of a block, on the device.

    The number of templates that there is room for is a power of two, because the programs that
    write and gather are compiled for every such number.
    """

    def __init__(self, points: int, most: int) -> None:
        """Room for the templates of at most `most` out of `points` points."""
        self._room = 1 << (most + largest_chunk() - 1).bit_length()
        self._place = np.full(points, -1, np.int32)
        self._used = 0
        self._stored: Templates | None = None

    def put(self, points: np.ndarray, made: Templates) -> None:
        """Store templates. Rows of `made` behind those of the points (n,) count for nothing."""
        self._place[points] = self._used + np.arange(len(points))
        if self._stored is None:
            self._stored = _blank(made, room=self._room)
        self._stored = _written(self._stored, made, jax.device_put(np.int32(self._used)))
        self._used += len(points)

    def take(self, points: np.ndarray) -> Templates:
        """The templates of points (n,), in this order; each has been stored."""
        assert self._stored is not None
        return _gathered(self._stored, jax.device_put(self._place[points]))


@functools.partial(jax.jit, static_argnames="room")
def _blank(like: Templates, *, room: int) -> Templates:
    return jax.tree.map(lambda a: jnp.zeros((room, *a.shape[1:]), a.dtype), like)


@functools.partial(jax.jit, donate_argnums=0)
def _written(stored: Templates, made: Templates, at: jax.Array) -> Templates:
    """The same memory with some rows replaced, from row `at` (int32 scalar) on."""
    return jax.tree.map(
        lambda old, new: lax.dynamic_update_slice_in_dim(old, new, at, 0), stored, made
    )


@jax.jit
def _gathered(stored: Templates, rows: jax.Array) -> Templates:
    return jax.tree.map(lambda a: a.at[rows].get(mode="promise_in_bounds"), stored)
