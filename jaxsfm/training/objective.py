"""The objective of the training: the probability that two walks end in the same place."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsfm.core.grid import FINE_STRIDE
from jaxsfm.core.losses import (
    CellPairs,
    agreement,
    cells_under_homography,
    epipolar_distances,
    peakiness,
    share_within,
    transfer_distances,
    weighted_mean,
)
from jaxsfm.core.numerics import squared_norm
from jaxsfm.core.relocalize import relocalize, walk
from jaxsfm.core.scores import heads_of, score
from jaxsfm.core.types import PRNGKey
from jaxsfm.core.vgg import VGG16, Preprocessing, preprocess
from jaxsfm.core.views import view_pair, warp_points

MATCH_ERROR_PX = 3.0
"""Standard deviation per axis of the error with which descriptors match cells. Training with exact
cells loses within 3 px what it gains within 1 px (docs/decisions/relocalization.md)."""


SIGMA_PX = 0.8
"""Distance over which two places agree, pixels."""
NEAR_PX, NEAR = 3.0, 0.3
"""Distance over which two places nearly agree, pixels, and the weight of that."""
FLOOR = 0.1
"""Is added to the probability before the logarithm is taken, so that cells which cannot agree have
less influence."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Objective:
    """How the walks in two views are compared. It is static in the training's programs."""

    temperature: float = 0.5
    """Temperature of the random walks in training; the walks of keypoints always take the best
    child."""
    peakiness: float = 0.0
    """Weight of the loss that makes the walks more certain of their end."""

    def __post_init__(self) -> None:
        if not self.temperature > 0:
            raise ValueError(f"Objective.temperature must be positive; got {self.temperature}")
        if self.peakiness < 0:
            raise ValueError(f"Objective.peakiness must be at least 0; got {self.peakiness}")


class Examples(NamedTuple):
    """Pairs of views with cells that show the same place."""

    maps0: tuple[Float[Array, "b h w c"], ...]
    """The maps of the first views that keypoints walk through: conv1_2, pool1, pool2."""
    maps1: tuple[Float[Array, "b h w c"], ...]
    """The same maps of the second views."""
    cells: CellPairs
    known: Float[Array, "b 3 3"]
    """The homography from the first view to the second (pixels), or the fundamental matrix F with
    x1' F x0 = 0."""


DISTANCES: dict[str, Callable[..., Array]] = {
    "homography": transfer_distances,
    "epipolar": epipolar_distances,
}
"""What `Examples.known` is -> the function that computes distances by it."""


@functools.partial(jax.jit, static_argnames=("preprocessing",))
def walked_maps(
    params: dict, views: Float[Array, "b v v 3"], *, preprocessing: Preprocessing
) -> tuple[Array, ...]:
    """Compute the maps of whole views (RGB in 0 .. 255) that keypoints walk through."""
    x = preprocess(views, preprocessing)
    size = jnp.broadcast_to(jnp.asarray(views.shape[1:3], jnp.int32), (views.shape[0], 2))
    return VGG16().apply(params, x, size, method="walked")  # pyright: ignore[reportReturnType]


@functools.partial(jax.jit, static_argnames=("preprocessing", "size"))
def warped_examples(
    params: dict,
    key: PRNGKey,
    crops: Float[Array, "b s s 3"],
    *,
    preprocessing: Preprocessing,
    size: int,
) -> Examples:
    """Make two views of every crop, related by a random homography, and compute their maps.

    Args:
      crops: RGB in 0 .. 255.
      size: the side of a view, pixels.
    """
    views_key, offsets_key = jax.random.split(key)
    keys = jax.random.split(views_key, crops.shape[0])
    pairs = jax.vmap(functools.partial(view_pair, size=size))(keys, crops)
    rows = size // FINE_STRIDE
    offsets = jax.random.normal(offsets_key, (crops.shape[0], rows * rows, 2)) * MATCH_ERROR_PX
    of_view = functools.partial(cells_under_homography, rows=rows, cols=rows)
    cells = jax.vmap(of_view)(pairs.h, offsets)
    maps0, maps1 = (
        walked_maps(params, views, preprocessing=preprocessing)
        for views in (pairs.view0, pairs.view1)
    )
    return Examples(maps0, maps1, cells, pairs.h)


def scored(scores: dict | None, maps: tuple[Array, ...]) -> list[Array]:
    """The score maps of one view, coarse to fine."""
    heads = heads_of(scores)
    return [score(x, head) for x, head in zip(maps, heads, strict=True)][::-1]


def loss(
    scores: dict, examples: Examples, *, objective: Objective, supervision: str = "homography"
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Compute the loss of scores on examples.

    It is the mean over cells of log((1 + floor) / (agreement + floor)), which is 0 if the walks
    agree for certain, plus the weighted lack of peakiness.

    Args:
      supervision: a key of `DISTANCES` that says what `examples.known` is.

    Returns: the loss, and figures to show by name.
    """

    def one(maps0, maps1, cells, known):
        first, second = (
            walk(
                scored(scores, maps),
                cell[:, 0],
                cell[:, 1],
                temperature=objective.temperature,
            )
            for maps, cell in ((maps0, cells.cell0), (maps1, cells.cell1))
        )
        squared = DISTANCES[supervision](known, first, second)
        agree = agreement(first, second, squared, sigma=SIGMA_PX)
        near = agreement(first, second, squared, sigma=NEAR_PX)
        agree = (agree + NEAR * near) / (1 + NEAR)
        return agree, (peakiness(first) + peakiness(second)) / 2

    agree, peaks = jax.vmap(one)(*examples)
    weight = examples.cells.weight.reshape(-1)
    surprise = jnp.log((1 + FLOOR) / (agree.reshape(-1) + FLOOR))
    repeatability = weighted_mean(surprise, weight)
    sure = weighted_mean(peaks.reshape(-1), weight)
    total = repeatability + objective.peakiness * (1 - sure)
    figures = {
        "loss": total,
        "agreement": weighted_mean(agree.reshape(-1), weight),
        "peakiness": sure,
    }
    return total, figures


@jax.jit
def shares(scores: dict | None, examples: Examples) -> dict[str, Array]:
    """Measure how many keypoints lie within 1 and 3 px of the other view's keypoint.

    Args:
      scores: the parameters of `jaxsfm.core.scores.Scores`; None takes the norm as the score.
      examples: pairs of views with known homographies.

    Returns: the shares `within_1` and `within_3`, and `cells`, the number of keypoints.
    """

    def places(maps: tuple[Array, ...], cell: Int[Array, "m 2"]) -> Float[Array, "m 2"]:
        return relocalize(scored(scores, maps), cell[:, 0], cell[:, 1])

    def one(maps0, maps1, cells, known):
        moved = warp_points(known, places(maps0, cells.cell0))
        return squared_norm(moved - places(maps1, cells.cell1))

    squared = jax.vmap(one)(*examples).reshape(-1)
    counts = examples.cells.weight.reshape(-1) > 0
    within = {f"within_{px}": share_within(squared, counts, px=float(px)) for px in (1, 3)}
    return within | {"cells": jnp.sum(counts).astype(jnp.float32)}


def mean_shares(each: Sequence[Mapping[str, Array]]) -> dict[str, float]:
    """Return the mean of the `shares` of several examples, weighted by their numbers of cells."""
    cells = sum(float(some["cells"]) for some in each)
    names = [name for name in each[0] if name != "cells"]
    return {
        name: sum(float(some[name] * some["cells"]) for some in each) / max(cells, 1.0)
        for name in names
    }
