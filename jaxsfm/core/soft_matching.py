"""Matching with gradients: a loss of the geometry reaches descriptors, scores and the network.

Mutual nearest neighbours and the walk of keypoints are decisions and have no gradient. Here both
are soft: every pair of cells has a weight, and every cell has a mean place. All pairs of fine cells
are held at once, so this is meant for small images or for chosen cells.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsfm.core.bundle_problem import Observations
from jaxsfm.core.grid import cell_rows_cols
from jaxsfm.core.losses import sampson_distances
from jaxsfm.core.numerics import HIGHEST, argmax_first, unit
from jaxsfm.core.relocalize import relocalize
from jaxsfm.core.scores import heads_of
from jaxsfm.core.types import Levels
from jaxsfm.core.vgg import VGG16


class Softness(NamedTuple):
    """How far decisions of the pipeline are softened in a loss."""

    match_temperature: float = 0.05
    """Temperature of `soft_mutual`."""
    walk_temperature: float = 0.5
    """Temperature of the soft walk of `jaxsfm.core.relocalize`."""
    scale: float = 3.0
    """Scale of `epipolar_loss`, pixels."""


def soft_mutual(
    a: Float[Array, "n c"], b: Float[Array, "m c"], *, temperature: Float[Array, ""] | float
) -> Float[Array, "n m"]:
    """The weight of every pair in [0, 1]: how much each cell is the other's nearest neighbour.

    As the temperature falls, the weight becomes 1 for mutual nearest neighbours and 0 for others.

    Source: the dual softmax of NCNet's and LoFTR's matching layers (Rocco et al. 2018, Sun et al.
    2021).

    Args:
      a, b: unit descriptors; all-zero rows match nothing.
      temperature: in units of the similarities, which lie in [-1, 1].
    """
    seen = jnp.any(a != 0, axis=1)[:, None] & jnp.any(b != 0, axis=1)
    logits = jnp.matmul(a, b.T, precision=HIGHEST) / temperature
    there, back = (jax.nn.softmax(logits, axis=axis, where=seen) for axis in (1, 0))
    return there * back


def fundamental_matrix(
    k0: Float[Array, "3 3"],
    k1: Float[Array, "3 3"],
    rotation: Float[Array, "3 3"],
    translation: Float[Array, " 3"],
) -> Float[Array, "3 3"]:
    """The matrix F of two cameras with x1' F x0 = 0, where X1 = rotation X0 + translation.

    It is differentiable in the pose, so a loss of F is a loss of the pose.

    Source: Hartley and Zisserman 2004, equation 9.2.
    """
    x, y, z = translation
    zero = jnp.zeros_like(x)
    cross = jnp.stack(
        [jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])]
    )
    essential = jnp.matmul(cross, rotation, precision=HIGHEST)
    inner = jnp.matmul(essential, jnp.linalg.inv(k0), precision=HIGHEST)
    return jnp.matmul(jnp.linalg.inv(k1).T, inner, precision=HIGHEST)


def soft_features(
    params: dict,
    scores: dict | None,
    image: Float[Array, "h w 3"],
    size: Int[Array, " 2"],
    *,
    temperature: Float[Array, ""] | float,
    children: int = 2,
) -> tuple[Float[Array, "m c"], Float[Array, "m 2"]]:
    """Unit pool3 descriptors and mean places (pixels) of all fine cells. Both are differentiable
    in `params` and in `scores`.

    Args:
      params: parameters of `VGG16`.
      scores: parameters of `jaxsfm.core.scores.Scores`; `None` scores by descriptor norms.
      image: network input, zero past `size`; its sides are multiples of 16.
      temperature, children: as in `relocalize`.
    """
    maps = VGG16().apply(params, image[None], size[None], heads_of(scores), method="levels")
    assert isinstance(maps, Levels)
    rows, cols, channels = maps.pool3.shape[1:]
    row, col = cell_rows_cols(rows * cols, jnp.int32(cols))
    xy = relocalize(
        [level[0] for level in reversed(maps.scores)],
        row,
        col,
        variant="soft",
        temperature=temperature,
        children=children,
    )
    return unit(maps.pool3[0].reshape(-1, channels)), xy


def epipolar_loss(
    matches: Float[Array, "n m"],
    xy0: Float[Array, "n 2"],
    xy1: Float[Array, "m 2"],
    f: Float[Array, "3 3"],
    *,
    scale: float = 3.0,
) -> Float[Array, ""]:
    """Weighted mean of d^2 / (d^2 + scale^2) over all pairs, in [0, 1], with Sampson distances d.

    Args:
      matches: weights of all pairs.
      f: fundamental matrix, x1' F x0 = 0.
      scale: the distance, pixels, that costs one half (Geman and McClure's loss).
    """
    squared = sampson_distances(f, xy0[:, None], xy1[None])
    error = squared / (squared + scale**2)
    return jnp.sum(matches * error) / (jnp.sum(matches) + 1e-12)


def observed(
    keypoints: Sequence[Float[Array, "_ 2"]], matches: Sequence[Float[Array, "n _"]]
) -> Observations:
    """Observations for `jaxsfm.core.bundle.adjust`: every cell of the first image is a point, which
    each other image sees at the cell with the largest weight. The rows are those of the first
    image, then those of the second, and so on; within an image, they are in the order of points.

    Gradients reach the keypoints, and through the weights the descriptors; which cell has the
    largest weight is a decision without a gradient.

    Args:
      keypoints: of every image, pixels.
      matches: for every image but the first, the weights of all pairs with it (`soft_mutual`).
    """
    xy, weight = [keypoints[0]], []
    for places, weights in zip(keypoints[1:], matches, strict=True):
        best, partner = argmax_first(weights, axis=1)
        xy.append(places[partner])
        weight.append(best)
    # The first image sees a point as surely as the image that sees it best.
    sure = jnp.max(jnp.stack(weight), axis=0)
    return Observations(jnp.concatenate(xy), jnp.concatenate([sure, *weight]))


def pair_loss(
    params: dict,
    scores: dict | None,
    images: Sequence[Float[Array, "h w 3"]],
    sizes: Sequence[Int[Array, " 2"]],
    f: Float[Array, "3 3"],
    *,
    softness: Softness | None = None,
) -> Float[Array, ""]:
    """`epipolar_loss` of two images, computed from their pixels. Its gradient reaches the scores,
    every layer of the network up to pool3, and the pose that `f` is made of.

    Args:
      params, scores: as in `soft_features`.
      images, sizes: as in `soft_features`, one each per image.
      softness: `None` takes the defaults.
    """
    softness = softness or Softness()
    (a, xy0), (b, xy1) = (
        soft_features(params, scores, image, size, temperature=softness.walk_temperature)
        for image, size in zip(images, sizes, strict=True)
    )
    matches = soft_mutual(a, b, temperature=softness.match_temperature)
    return epipolar_loss(matches, xy0, xy1, f, scale=softness.scale)
