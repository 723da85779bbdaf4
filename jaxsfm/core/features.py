"""The features of one image: descriptors of two layers, and a keypoint for every fine cell.

They are made of the maps of a backbone: a flax module with a method `levels(images, size, heads)`
that returns `Levels`: score maps of strides 1, 2 and 4, which keypoints walk down, and descriptors
of strides 8 and 16. Later stages do not depend on which network it was (docs/guide/backbones.md).
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from jaxsfm.core import alexnet
from jaxsfm.core.grid import FINE_STRIDE, cell_rows_cols, cell_to_px
from jaxsfm.core.numerics import squared_norm, unit
from jaxsfm.core.octaves import halve, octave_capacity
from jaxsfm.core.pair_shape import FINE_STRIDES, PAPER_LAYERS, Layers
from jaxsfm.core.relocalize import relocalize
from jaxsfm.core.scores import heads_of
from jaxsfm.core.types import DenseFeatures, Levels
from jaxsfm.core.vgg import (
    BLOCKS,
    BLOCKS_19,
    VGG16,
    VGG19,
    Blocks,
    Preprocessing,
    layers_of,
    preprocess,
)

LEAST_DIFFERENCE = 1e-3
"""Smallest distance between a unit descriptor and the mean of its image for it to count."""


class Backbone(NamedTuple):
    """A network and its shapes."""

    module: type[nn.Module]
    """The flax module; its constructor takes `bfloat16`."""
    kernels: dict[str, tuple[int, int, int, int]]
    """Layer name -> HWIO shape of its kernel. The parameters of a layer are `kernel` and `bias`."""
    fine: int
    """Number of channels of the descriptors of stride 8."""
    coarse: int
    """Number of channels of the descriptors of stride 16."""
    learned: bool
    """Whether relocalizers can be learned for its maps."""


def _vgg(module: type[nn.Module], blocks: Blocks, *, learned: bool) -> Backbone:
    kernels = {name: (3, 3, *channels) for name, channels in layers_of(blocks).items()}
    return Backbone(module, kernels, fine=blocks[2][-1], coarse=blocks[3][-1], learned=learned)


BACKBONES: dict[str, Backbone] = {
    "vgg16": _vgg(VGG16, BLOCKS, learned=True),
    "vgg19": _vgg(VGG19, BLOCKS_19, learned=False),
    "alexnet": Backbone(alexnet.AlexNet, alexnet.KERNELS, fine=192, coarse=256, learned=False),
}


class Walk(NamedTuple):
    """How keypoints are relocalized."""

    levels: int | None = None
    """The number of levels that a keypoint walks down; `None` stands for all, to a pixel. With
    fewer it lies at the centre of the cell where it ends: with 0, of its fine cell."""
    children: int = 2
    """Children per axis among which it chooses at each level (K in the paper)."""


TO_PIXELS = Walk()
"""The rule of the paper."""


class Extraction(NamedTuple):
    """The static, hashable settings of `extract`."""

    preprocessing: Preprocessing
    num_coarse: int
    """Capacity for coarse cells of the first octave; that for fine cells is four times as large."""
    backbone: str = "vgg16"
    """One of `jaxsfm.core.features.BACKBONES`."""
    layers: Layers = PAPER_LAYERS
    walk: Walk = TO_PIXELS
    octaves: int = 1
    centred: bool = False
    bfloat16: bool = False


def _flatten(
    feature_map: Float[Array, "h w c"], grid: Int[Array, " 2"], *, capacity: int, centred: bool
) -> Float[Array, "capacity c"]:
    """Unit descriptors of the valid cells in row order, followed by zero rows."""
    row, col = cell_rows_cols(capacity, jnp.maximum(grid[1], 1))
    h, w, c = feature_map.shape
    inside = (row < grid[0]) & (grid[1] > 0)
    flat = jnp.take(feature_map.reshape(h * w, c), jnp.where(inside, row * w + col, 0), axis=0)
    flat = jnp.where(inside[:, None], unit(flat), 0.0)
    if centred:
        seen = jnp.any(flat != 0, axis=1)
        mean = jnp.sum(flat, axis=0) / jnp.maximum(jnp.sum(seen), 1).astype(flat.dtype)
        rest = flat - mean
        # A cell that differs from the mean by no more than rounding (a blank wall) shows nothing.
        seen &= squared_norm(rest) > LEAST_DIFFERENCE**2
        flat = jnp.where(seen[:, None], unit(rest), 0.0)
    return flat


def dense_features(
    octaves: Sequence[Levels],
    size: Int[Array, " 2"],
    *,
    num_coarse: int,
    num_fine: int,
    fine_stride: int = FINE_STRIDE,
    walk: Walk = TO_PIXELS,
    centred: bool = False,
) -> DenseFeatures:
    """The features of an image from its maps.

    Args:
      octaves: maps of the image, of the image at half its size, and so on; all have a batch axis
        of 1.
      size: valid (rows, columns) of the image.
      num_coarse, num_fine: capacities of the first octave, at least the number of valid cells.
      fine_stride: stride of the fine maps, pixels.
      walk: how keypoints are relocalized.
      centred: the mean descriptor of an octave is subtracted from its descriptors, which are then
        scaled to unit length again.
    """
    fine_grid, coarse_grid = size // fine_stride, size // (2 * fine_stride)
    row, col = cell_rows_cols(num_fine, fine_grid[1])
    scores = [score[0] for score in reversed(octaves[0].scores)][: walk.levels]
    if scores:
        cells = relocalize(scores, row, col, children=walk.children)
    else:
        cells = jnp.stack([col, row], axis=-1).astype(jnp.float32)
    keypoints = cell_to_px(cells, stride=fine_stride >> len(scores))

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
    """The features as they are stored, with descriptors as float16.

    This moves a unit vector by at most 2.4e-4, a thousandth of the distance between neighbouring
    cells (docs/decisions/features.md).
    """

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
    """The features of one RGB image.

    Args:
      params: parameters of the backbone.
      image: RGB, padded at the bottom and on the right beyond `size`. Both sides are multiples of
        2^(octaves - 1).
      size: valid (rows, columns).
      scores: parameters of `jaxsfm.core.scores.Scores`, which move the keypoints; `None` scores by
        descriptor norms.
    """
    x = preprocess(image, settings.preprocessing)
    network = BACKBONES[settings.backbone].module(bfloat16=settings.bfloat16)
    maps_of = functools.partial(network.apply, method="levels")
    if settings.layers != PAPER_LAYERS:  # only VGG has others
        maps_of = functools.partial(maps_of, layers=settings.layers)
    levels: list[Levels] = []
    for k in range(settings.octaves):
        # Keypoints come from the first octave.
        heads = heads_of(scores if k == 0 else None)
        maps = maps_of(params, x[None], (size >> k)[None], heads)
        assert isinstance(maps, Levels)
        levels.append(maps)
        if k + 1 < settings.octaves:
            x = halve(x)
    return dense_features(
        levels,
        size,
        num_coarse=settings.num_coarse,
        num_fine=4 * settings.num_coarse,
        fine_stride=FINE_STRIDES[settings.layers],
        walk=settings.walk,
        centred=settings.centred,
    )
