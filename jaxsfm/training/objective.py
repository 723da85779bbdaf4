"""What is trained for: the probability that two walks end in the same place."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

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
"""Of the cells that descriptors match, per axis: training with the exact cell instead loses within
3 px what it gains within 1 px (docs/relocalization.md)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Objective:
    """How walks of two views are compared; static in the training's programs."""

    temperature: float = 0.5
    """Of the walks, in training; keypoints are hard."""
    sigma_px: float = 0.8
    """How far apart two places agree."""
    near_px: float = 3.0
    """How far apart they nearly agree."""
    near: float = 0.3
    """Weight of that."""
    floor: float = 0.1
    """Added to the probability before its logarithm: cells that cannot meet pull less."""
    peakiness: float = 0.0
    """Weight of the walks' lack of peakiness."""
    children: int = 2
    """Per axis and level (K in the paper); the pipeline walks with 2."""

    def __post_init__(self) -> None:
        for name in ("temperature", "sigma_px", "near_px", "floor"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Objective.{name} must be positive; got {getattr(self, name)}")
        for name in ("near", "peakiness"):
            if getattr(self, name) < 0:
                raise ValueError(f"Objective.{name} must be at least 0; got {getattr(self, name)}")


class Examples(NamedTuple):
    """Pairs of views, as the maps that keypoints walk through, with cells that see the same."""

    maps0: tuple[Float[Array, "b h w c"], ...]
    """conv1_2, pool1, pool2."""
    maps1: tuple[Float[Array, "b h w c"], ...]
    cells: CellPairs
    known: Float[Array, "b 3 3"]
    """View 0 to view 1 (pixels), or the fundamental matrix, x1' F x0 = 0."""


DISTANCES: dict[str, Callable[..., Array]] = {
    "homography": transfer_distances,
    "epipolar": epipolar_distances,
}


@functools.partial(jax.jit, static_argnames=("preprocessing",))
def walked_maps(
    params: dict, views: Float[Array, "b v v 3"], *, preprocessing: Preprocessing
) -> tuple[Array, ...]:
    """The maps that keypoints of whole views (0 .. 255) walk through."""
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
    """Two views of every crop, and their maps.

    Args:
      params: of `VGG16`.
      size: of the views, pixels.
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


def _scored(scores: dict | None, maps: tuple[Array, ...]) -> list[Array]:
    """Score maps of one view, coarse to fine."""
    heads = heads_of(scores)
    return [score(x, head) for x, head in zip(maps, heads, strict=True)][::-1]


def loss(
    scores: dict, examples: Examples, *, objective: Objective, supervision: str = "homography"
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Mean over cells of log((1 + floor) / (agreement + floor)), 0 for certain agreement, plus the
    weighted lack of peakiness; and figures.

    Args:
      scores: parameters of `jaxsfm.core.scores.Scores`.
      supervision: a key of DISTANCES: what `examples.known` is.
    """

    def one(maps0, maps1, cells, known):
        first, second = (
            walk(
                _scored(scores, maps),
                cell[:, 0],
                cell[:, 1],
                temperature=objective.temperature,
                children=objective.children,
            )
            for maps, cell in ((maps0, cells.cell0), (maps1, cells.cell1))
        )
        squared = DISTANCES[supervision](known, first, second)
        agree = agreement(first, second, squared, sigma=objective.sigma_px)
        near = agreement(first, second, squared, sigma=objective.near_px)
        agree = (agree + objective.near * near) / (1 + objective.near)
        return agree, (peakiness(first) + peakiness(second)) / 2

    agree, peaks = jax.vmap(one)(*examples)
    weight = examples.cells.weight.reshape(-1)
    surprise = jnp.log((1 + objective.floor) / (agree.reshape(-1) + objective.floor))
    repeatability = weighted_mean(surprise, weight)
    sure = weighted_mean(peaks.reshape(-1), weight)
    total = repeatability + objective.peakiness * (1 - sure)
    figures = {
        "loss": total,
        "agreement": weighted_mean(agree.reshape(-1), weight),
        "peakiness": sure,
    }
    return total, figures


@functools.partial(jax.jit, static_argnames=("children",))
def shares(scores: dict | None, examples: Examples, *, children: int = 2) -> dict[str, Array]:
    """Shares of hard keypoints within 1 and 3 px of the other view's, under the known homography.

    Args:
      scores: parameters of `jaxsfm.core.scores.Scores`; None: the norm rule.
    """

    def places(maps: tuple[Array, ...], cell: Int[Array, "m 2"]) -> Float[Array, "m 2"]:
        return relocalize(_scored(scores, maps), cell[:, 0], cell[:, 1], children=children)

    def one(maps0, maps1, cells, known):
        moved = warp_points(known, places(maps0, cells.cell0))
        return squared_norm(moved - places(maps1, cells.cell1))

    squared = jax.vmap(one)(*examples).reshape(-1)
    counts = examples.cells.weight.reshape(-1) > 0
    within = {f"within_{px}": share_within(squared, counts, px=float(px)) for px in (1, 3)}
    return within | {"cells": jnp.sum(counts).astype(jnp.float32)}


def mean_shares(each: list[dict[str, Any]]) -> dict[str, float]:
    """Of several examples' `shares`, by their cells."""
    cells = sum(float(some["cells"]) for some in each)
    names = [name for name in each[0] if name != "cells"]
    return {
        name: sum(float(some[name] * some["cells"]) for some in each) / max(cells, 1.0)
        for name in names
    }
