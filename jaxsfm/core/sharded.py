"""Batches over all devices: every device runs the same program on its own items.

Items are laid along the one axis of a mesh (`jax.sharding`). Devices exchange nothing. So the
result of an item is what one device alone computes, and a loop on a device ends when the items of
that device are done.
"""

import functools
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, UInt8, UInt32

from jaxsfm.core.features import Extraction, extract, stored
from jaxsfm.core.numerics import one_by_one
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.pair import match_pairs, pair_key
from jaxsfm.core.pair_shape import PairShape, Products
from jaxsfm.core.types import DenseFeatures, JoinedFeatures, PairMatches, PRNGKey, Thresholds

P = ParamSpec("P")
T = TypeVar("T")
AXIS = "items"
_EACH, _SAME = PartitionSpec(AXIS), PartitionSpec()


def device_mesh(devices: Sequence[object]) -> Mesh:
    """A mesh with one axis over the devices."""
    return Mesh(np.asarray(devices), (AXIS,))


def _sharded(
    function: Callable[P, T],
    mesh: Mesh,
    in_specs: tuple[PartitionSpec, ...],
    out_specs: PartitionSpec,
) -> Callable[P, T]:
    # The check that values vary over the same axes is off, because loops start from constants.
    return jax.shard_map(
        function, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
    )


@functools.partial(jax.jit, static_argnames=("mesh", "settings"))
def extract_batch(
    params: dict,
    scores: dict | None,
    images: UInt8[Array, "b h w 3"],
    sizes: Int[Array, "b 2"],
    *,
    mesh: Mesh,
    settings: Extraction,
) -> DenseFeatures:
    """Features of images of one padded size, as `jaxsfm.core.features.stored` keeps them.

    Args:
      params, scores: as in `jaxsfm.core.features.extract`.
      images: RGB; their number is a multiple of the number of devices.
      sizes: valid (rows, columns) of each image.
    """

    def local(params, scores, images, sizes):
        def one(item):
            return stored(extract(params, *item, settings=settings, scores=scores))

        return one_by_one(one, (images, sizes), batch_size=len(sizes))

    specs = (_SAME, _SAME, _EACH, _EACH)
    return _sharded(local, mesh, specs, _EACH)(params, scores, images, sizes)


@functools.partial(jax.jit, static_argnames=("mesh", "products"))
def join_everywhere(
    features: DenseFeatures, *, mesh: Mesh, products: Products = "float32"
) -> JoinedFeatures:
    """The joined features of one image, copied to every device along a leading axis of devices.

    Args:
      products: as in `jaxsfm.core.octaves.join_octaves`.
    """

    def local(features):
        return jax.tree.map(lambda x: x[None], join_octaves(features, products=products))

    return _sharded(local, mesh, (_SAME,), _EACH)(features)


def pick(joined: Sequence[JoinedFeatures], *, mesh: Mesh) -> JoinedFeatures:
    """For each device the features of another image, along a leading axis of devices.

    They are taken from results of `join_everywhere`, and nothing is copied.
    """
    if mesh.size == 1:
        return joined[0]
    sharding = NamedSharding(mesh, _EACH)
    places = {device: d for d, device in enumerate(mesh.devices.flat)}

    def one(*arrays):
        shards = [
            next(s.data for s in array.addressable_shards if places[s.device] == d)
            for d, array in enumerate(arrays)
        ]
        return jax.make_array_from_single_device_arrays(arrays[0].shape, sharding, shards)

    return jax.tree.map(one, *joined)


@functools.partial(jax.jit, static_argnames=("mesh", "shape"))
def match_batch(
    root: PRNGKey,
    identities: UInt32[Array, "d b 2"],
    sides: tuple[tuple[JoinedFeatures, JoinedFeatures], ...],
    thresholds: Thresholds,
    *,
    mesh: Mesh,
    shape: PairShape,
) -> PairMatches:
    """`jaxsfm.core.pair.match_pairs` with b vmapped pairs on each of d devices.

    Args:
      root: key of the run, from which `pair_key` makes the key of a pair.
      identities: identities of the two images of every pair.
      sides: for each of the b pairs the features of both images, with a leading axis d (from
        `pick`).

    Returns:
      Matches with leading axes d, b.
    """

    def local(root, identities, sides, thresholds):
        keys = jax.vmap(lambda ids: pair_key(root, ids[0], ids[1]))(identities[0])
        left, right = jax.tree.map(lambda *x: jnp.concatenate(x), *sides)
        found = match_pairs(keys, left, right, thresholds, shape=shape, batch_size=len(sides))
        return jax.tree.map(lambda x: x[None], found)

    specs = (_SAME, _EACH, _EACH, _SAME)
    return _sharded(local, mesh, specs, _EACH)(root, identities, sides, thresholds)
