"""One image -> DenseFeatures: descriptors of two layers and a keypoint for every fine cell."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxsfm.core.grid import COARSE_STRIDE, FINE_STRIDE, cell_rows_cols, cell_to_px
from jaxsfm.core.numerics import squared_norm, unit
from jaxsfm.core.octaves import halve, octave_capacity
from jaxsfm.core.relocalize import flat_pyramid, relocalize
from jaxsfm.core.types import DenseFeatures, Pyramid
from jaxsfm.core.vgg import VGG16, Preprocessing, preprocess

LEAST_DIFFERENCE = 1e-3
"""Between a unit descriptor and its image's mean, for the descriptor to count."""


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
    pyramids: Sequence[Pyramid],
    size: Int[Array, " 2"],
    *,
    num_coarse: int,
    num_fine: int,
    relocalized: bool,
    centred: bool = False,
) -> DenseFeatures:
    """Descriptors and keypoints of an image's pyramids, each with batch axis 1.

    Any backbone with maps of halving size can stand in for VGG here.

    Args:
      pyramids: of the image, of the image at half its size, ...
      size: valid (rows, columns) of the image.
      num_coarse, num_fine: capacities of the first octave, at least the number of valid cells.
      relocalized: keypoints by relocalization; False puts them at the cells' centres.
      centred: subtract an octave's mean descriptor from all of them, before normalising again.
    """
    fine_grid, coarse_grid = size // FINE_STRIDE, size // COARSE_STRIDE
    row, col = cell_rows_cols(num_fine, fine_grid[1])
    if relocalized:
        first = pyramids[0]
        norms, levels = flat_pyramid([first.pool2[0], first.pool1[0], first.conv1_2[0]])
        keypoints = relocalize(norms, levels, row, col)
    else:
        cells = jnp.stack([col, row], axis=-1).astype(jnp.float32)
        keypoints = cell_to_px(cells, stride=FINE_STRIDE)

    def descriptors(maps: Sequence[Array], grid: Array, capacity: int) -> tuple[Array, ...]:
        return tuple(
            _flatten(m[0], grid >> k, capacity=octave_capacity(capacity, k), centred=centred)
            for k, m in enumerate(maps)
        )

    return DenseFeatures(
        coarse=descriptors([p.pool4 for p in pyramids], coarse_grid, num_coarse),
        fine=descriptors([p.pool3 for p in pyramids], fine_grid, num_fine),
        keypoints=jnp.where((row < fine_grid[0])[:, None], keypoints, 0.0),
        coarse_grid=coarse_grid.astype(jnp.int32),
        fine_grid=fine_grid.astype(jnp.int32),
    )


@functools.partial(
    jax.jit,
    static_argnames=(
        "preprocessing",
        "num_coarse",
        "num_fine",
        "relocalized",
        "octaves",
        "centred",
    ),
)
def extract(
    params: dict,
    image: UInt8[Array, "h w 3"],
    size: Int[Array, " 2"],
    *,
    preprocessing: Preprocessing,
    num_coarse: int,
    num_fine: int,
    relocalized: bool,
    octaves: int = 1,
    centred: bool = False,
) -> DenseFeatures:
    """DenseFeatures of one RGB image, padded at the bottom and on the right beyond `size`.

    Both padded sides must be multiples of 2^(octaves - 1).
    """
    x = preprocess(image, preprocessing)
    pyramids = []
    for k in range(octaves):
        pyramid = VGG16().apply(params, x[None], (size >> k)[None])
        assert isinstance(pyramid, Pyramid)
        pyramids.append(pyramid)
        if k + 1 < octaves:
            x = halve(x)
    return dense_features(
        pyramids,
        size,
        num_coarse=num_coarse,
        num_fine=num_fine,
        relocalized=relocalized,
        centred=centred,
    )
