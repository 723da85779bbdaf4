"""One image -> DenseFeatures: descriptors of two layers and a keypoint for every fine cell."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxsfm.core.grid import FINE_STRIDE, cell_rows_cols, cell_to_px
from jaxsfm.core.numerics import unit
from jaxsfm.core.relocalize import flat_pyramid, relocalize
from jaxsfm.core.types import DenseFeatures, Pyramid
from jaxsfm.core.vgg import VGG16, Preprocessing, preprocess


def _flatten(
    feature_map: Float[Array, "h w c"], grid: Int[Array, " 2"], *, capacity: int
) -> Float[Array, "capacity c"]:
    """Unit descriptors of the valid cells in row order, zero rows after them."""
    row, col = cell_rows_cols(capacity, grid[1])
    h, w, c = feature_map.shape
    inside = row < grid[0]
    flat = jnp.take(feature_map.reshape(h * w, c), jnp.where(inside, row * w + col, 0), axis=0)
    return jnp.where(inside[:, None], unit(flat), 0.0)


def dense_features(
    pyramid: Pyramid, size: Int[Array, " 2"], *, num_coarse: int, num_fine: int, relocalized: bool
) -> DenseFeatures:
    """Descriptors and keypoints of a pyramid with batch axis 1.

    Any backbone with maps of halving size can stand in for VGG here.

    Args:
      size: valid (rows, columns) of the image.
      num_coarse, num_fine: capacities, at least the number of valid cells.
      relocalized: keypoints by relocalization; False puts them at the cells' centres.
    """
    fine_grid, coarse_grid = size // 8, size // 16
    row, col = cell_rows_cols(num_fine, fine_grid[1])
    if relocalized:
        norms, levels = flat_pyramid([pyramid.pool2[0], pyramid.pool1[0], pyramid.conv1_2[0]])
        keypoints = relocalize(norms, levels, row, col)
    else:
        cells = jnp.stack([col, row], axis=-1).astype(jnp.float32)
        keypoints = cell_to_px(cells, stride=FINE_STRIDE)
    return DenseFeatures(
        coarse=_flatten(pyramid.pool4[0], coarse_grid, capacity=num_coarse),
        fine=_flatten(pyramid.pool3[0], fine_grid, capacity=num_fine),
        keypoints=jnp.where((row < fine_grid[0])[:, None], keypoints, 0.0),
        coarse_grid=coarse_grid.astype(jnp.int32),
        fine_grid=fine_grid.astype(jnp.int32),
    )


@functools.partial(
    jax.jit, static_argnames=("preprocessing", "num_coarse", "num_fine", "relocalized")
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
) -> DenseFeatures:
    """DenseFeatures of one RGB image, padded at the bottom and on the right beyond `size`."""
    x = preprocess(image, preprocessing)[None]
    pyramid = VGG16().apply(params, x, size[None])
    assert isinstance(pyramid, Pyramid)
    return dense_features(
        pyramid, size, num_coarse=num_coarse, num_fine=num_fine, relocalized=relocalized
    )
