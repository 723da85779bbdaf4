"""One image -> DenseFeatures: descriptors of two layers and a keypoint for every fine cell."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxsfm.core.backbones import BACKBONES
from jaxsfm.core.grid import COARSE_STRIDE, FINE_STRIDE, cell_rows_cols, cell_to_px
from jaxsfm.core.numerics import squared_norm, unit
from jaxsfm.core.octaves import halve, octave_capacity
from jaxsfm.core.relocalize import relocalize
from jaxsfm.core.scores import heads_of
from jaxsfm.core.types import DenseFeatures, Levels
from jaxsfm.core.vgg import Preprocessing, preprocess

LEAST_DIFFERENCE = 1e-3
"""Between a unit descriptor and its image's mean, for the descriptor to count."""


class Extraction(NamedTuple):
    """What fixes the program of `extract`, beside the image's shape; hashable."""

    preprocessing: Preprocessing
    num_coarse: int
    """Capacity of the first octave; there are four times as many fine cells."""
    backbone: str = "vgg16"
    """One of `jaxsfm.core.backbones.BACKBONES`."""
    relocalized: bool = True
    octaves: int = 1
    centred: bool = False
    bfloat16: bool = False


def _flatten(
    feature_map: Float[Array, "h w c"], grid: Int[Array, " 2"], *, capacity: int, centred: bool
) -> Float[Array, "capacity c"]:
    """Unit descriptors of the valid cells in row order, zero rows after them."""
    row, col = cell_rows_cols(capacity, jnp.maximum(grid[1], 1))
    h, w, c = feature_map.shape
    inside = (row < grid[0]) & (grid[1] > 0)
    flat = jnp.take(feature_map.reshape(h * w, c), jnp.where(inside, row * w + col, 0), axis=0)
    flat = jnp.where(inside[:, None], unit(flat), 0.0)
    if centred:
        seen = jnp.any(flat != 0, axis=1)
        mean = jnp.sum(flat, axis=0) / jnp.maximum(jnp.sum(seen), 1).astype(flat.dtype)
        rest = flat - mean
        # What differs from the mean by rounding alone (a blank wall) shows nothing.
        seen &= squared_norm(rest) > LEAST_DIFFERENCE**2
        flat = jnp.where(seen[:, None], unit(rest), 0.0)
    return flat


def dense_features(
    octaves: Sequence[Levels],
    size: Int[Array, " 2"],
    *,
    num_coarse: int,
    num_fine: int,
    relocalized: bool,
    centred: bool = False,
) -> DenseFeatures:
    """Descriptors and keypoints of an image from its maps, each with batch axis 1.

    Args:
      octaves: of the image, of the image at half its size, ...
      size: valid (rows, columns) of the image.
      num_coarse, num_fine: capacities of the first octave, at least the number of valid cells.
      relocalized: keypoints by relocalization; False puts them at the cells' centres.
      centred: subtract an octave's mean descriptor from all of them, before normalising again.
    """
    fine_grid, coarse_grid = size // FINE_STRIDE, size // COARSE_STRIDE
    row, col = cell_rows_cols(num_fine, fine_grid[1])
    if relocalized:
        scores = [score[0] for score in reversed(octaves[0].scores)]
        keypoints = relocalize(scores, row, col)
    else:
        cells = jnp.stack([col, row], axis=-1).astype(jnp.float32)
        keypoints = cell_to_px(cells, stride=FINE_STRIDE)

    def descriptors(maps: Sequence[Array], grid: Array, capacity: int) -> tuple[Array, ...]:
        return tuple(
            _flatten(m[0], grid >> k, capacity=octave_capacity(capacity, k), centred=centred)
            for k, m in enumerate(maps)
        )

    return DenseFeatures(
        coarse=descriptors([o.pool4 for o in octaves], coarse_grid, num_coarse),
        fine=descriptors([o.pool3 for o in octaves], fine_grid, num_fine),
        keypoints=jnp.where((row < fine_grid[0])[:, None], keypoints, 0.0),
        coarse_grid=coarse_grid.astype(jnp.int32),
        fine_grid=fine_grid.astype(jnp.int32),
    )


def stored(features: DenseFeatures) -> DenseFeatures:
    """The same with descriptors of half the size, as they are kept: float16, which moves a unit
    vector by 2.4e-4 at most, a thousandth of what separates neighbouring cells
    (docs/decisions/features.md)."""

    def half(octaves: tuple[Array, ...]) -> tuple[Array, ...]:
        return tuple(octave.astype(jnp.float16) for octave in octaves)

    return features._replace(coarse=half(features.coarse), fine=half(features.fine))


@functools.partial(jax.jit, static_argnames=("settings",))
def extract(
    params: dict,
    image: UInt8[Array, "h w 3"],
    size: Int[Array, " 2"],
    *,
    settings: Extraction,
    scores: dict | None = None,
) -> DenseFeatures:
    """DenseFeatures of one RGB image, padded at the bottom and on the right beyond `size`.

    Both padded sides must be multiples of 2^(octaves - 1).

    Args:
      params: of the backbone.
      scores: of `jaxsfm.core.scores.Scores`, for keypoints; None: the norm rule.
    """
    x = preprocess(image, settings.preprocessing)
    network = BACKBONES[settings.backbone].module(bfloat16=settings.bfloat16)
    levels: list[Levels] = []
    for k in range(settings.octaves):
        # Keypoints are the first octave's.
        heads = heads_of(scores if k == 0 else None)
        maps = network.apply(params, x[None], (size >> k)[None], heads, method="levels")
        assert isinstance(maps, Levels)
        levels.append(maps)
        if k + 1 < settings.octaves:
            x = halve(x)
    return dense_features(
        levels,
        size,
        num_coarse=settings.num_coarse,
        num_fine=4 * settings.num_coarse,
        relocalized=settings.relocalized,
        centred=settings.centred,
    )
