"""Extraction and matching as programs that run without jaxsfm (`jax.export`)."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import export

from jaxsfm.config import Config
from jaxsfm.core.features import extract
from jaxsfm.core.lanes import in_turn_on_cpus
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.pair import match_pair
from jaxsfm.core.types import JoinedFeatures, OctavePart
from jaxsfm.io.features import feature_capacity, padded_size
from jaxsfm.io.weights import Weights
from jaxsfm.matching.extraction import extraction_settings
from jaxsfm.matching.pair_matching import pair_shape, thresholds

PLATFORMS = ("cpu", "cuda", "tpu")


class Programs(NamedTuple):
    """Two serialized programs for photos of one size. They take and return plain arrays."""

    extract: bytes
    """(rgb, size) -> features. rgb: uint8 (rows, columns, 3), the photo padded at the bottom and on
    the right to `jaxsfm.io.features.padded_size`; size: int32 (2,), its rows and columns. The
    features are a dict of the fields of `jaxsfm.core.types.JoinedFeatures`, where `coarse_parts` is
    a list of dicts. The weights are in the program. If it is for batches, all arrays have a leading
    axis of photos."""
    match: bytes
    """(seed, features, features) -> matches. seed: uint32, the same for both orders of a pair; the
    matches are a dict of the fields of `jaxsfm.core.types.PairMatches`, in pixels of the working
    images and cells."""


def export_programs(
    weights: Weights,
    size: tuple[int, int],
    *,
    config: Config,
    platforms: Sequence[str] = PLATFORMS,
    batch: bool = False,
) -> Programs:
    """Export extraction and matching for photos of one working size.

    Args:
      size: (width, height) of the photos, at most `config.max_size`; they are not reduced.
      platforms: the platforms that the programs can run on.
      batch: the extraction is for any number of photos. CPUs compute them in turn, and accelerators
        all together. `jaxsfm.matching.execution.ACCELERATOR_BYTES_PER_PIXEL` is the memory that a
        run plans for.
    """
    capacity = feature_capacity(size)
    settings = extraction_settings(weights, config, capacity.num_coarse)
    shape, limits = pair_shape(config, capacity), thresholds(config)
    parameters = weights.params, weights.scores(config)

    def features(parameters, rgb, size):
        params, scores = parameters
        dense = extract(params, rgb, size, settings=settings, scores=scores)
        joined = join_octaves(dense, products=config.products)._asdict()
        return joined | {"coarse_parts": [part._asdict() for part in joined["coarse_parts"]]}

    def matches(seed, features0, features1):
        pair = [
            JoinedFeatures(**each)._replace(
                coarse_parts=tuple(OctavePart(**part) for part in each["coarse_parts"])
            )
            for each in (features0, features1)
        ]
        return match_pair(jax.random.key(seed), *pair, limits, shape=shape)._asdict()

    photo = jax.ShapeDtypeStruct((*padded_size(size), 3), jnp.uint8)
    rows_and_columns = jax.ShapeDtypeStruct((2,), jnp.int32)
    found = jax.eval_shape(features, parameters, photo, rows_and_columns)
    given = photo, rows_and_columns
    if batch:
        features = jax.vmap(in_turn_on_cpus(features), in_axes=(None, 0, 0))
        any_number = export.symbolic_shape("photos")
        given = tuple(jax.ShapeDtypeStruct((*any_number, *x.shape), x.dtype) for x in given)
    number = jax.ShapeDtypeStruct((), jnp.uint32)
    return Programs(
        _exported(partial(features, parameters), given, platforms),
        _exported(matches, (number, found, found), platforms),
    )


def _exported(function, given: Sequence, platforms: Sequence[str]) -> bytes:
    return bytes(export.export(jax.jit(function), platforms=list(platforms))(*given).serialize())
