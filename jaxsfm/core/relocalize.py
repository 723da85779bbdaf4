"""Keypoint relocalization: every fine cell walks down the pyramid to one pixel.

From a pool3 cell to the child with the largest score in pool2, then in pool1, then in conv1_2; the
score is the descriptor's norm (paper, section 3.2) or a learned one (`jaxsfm.core.scores`). It
depends on one image alone, so a keypoint's index is its cell's index in every pair, and tracks are
consistent by construction. With 2 x 2 children those of different cells are disjoint: two keypoints
never coincide.

The same walk at random, where a child is taken with a probability that grows with its score, has
probabilities for all pixels; its expectation is continuous and differentiable (`soft`), and as the
temperature falls it becomes the hard walk.

Scores are positive and only their order within a block matters to the hard walk: squared norms
order as norms do.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

FACTOR = 2
"""Ratio of neighbouring levels."""
LEAST_SCORE = 1e-3
"""Added to scores before their logarithm: blocks of zeros have finite gradients. Squared norms of
conv1_2 are around 10, of pool2 around 1000."""

Variant = Literal["hard", "soft", "straight-through"]


class WalkProbabilities(NamedTuple):
    """Where random walks end: for every cell a window of the finest map."""

    p: Float[Array, "m s s"]
    """Probability of each cell of the window, (row, column); they sum to 1."""
    start: Int[Array, "m 2"]
    """(x, y) of the window's first cell; it may lie outside the map, where p is 0."""


def _check(
    scores: Sequence[Array], children: int, temperature: Float[Array, ""] | float = 1.0
) -> None:
    if isinstance(temperature, float) and not temperature > 0:
        raise ValueError(f"relocalize: temperature must be positive; got {temperature}")
    if not scores:
        raise ValueError("relocalize: at least one level is required; got none")
    if children < 2 or children % 2:
        raise ValueError(f"relocalize: children must be even and at least 2; got {children}")
    for above, below in zip(scores, scores[1:], strict=False):
        if below.shape != (FACTOR * above.shape[0], FACTOR * above.shape[1]):
            raise ValueError(
                f"relocalize: each level must be twice the size of the last; got {above.shape} "
                f"and {below.shape}"
            )


def _first_child(children: int) -> int:
    """Of a block of `children` per axis around the 2 x 2 cells below a cell."""
    return -((children - FACTOR) // 2)


def relocalize(
    scores: Sequence[Float[Array, "_h _w"]],
    row: Int[Array, " m"],
    col: Int[Array, " m"],
    *,
    variant: Variant = "hard",
    temperature: Float[Array, ""] | float = 1.0,
    children: int = FACTOR,
) -> Float[Array, "m 2"]:
    """(x, y) that every cell walks to, in cells of the finest map: pixels if that is the image's
    size, else to be turned into pixels by `jaxsfm.core.grid.cell_to_px`.

    Args:
      scores: positive score maps, coarse to fine, each twice the size of the last; the first one
        is twice the size of the map that (row, col) are cells of. As many as levels are walked.
      row, col: the cells; those whose children lie outside the maps give unspecified values.
      variant: "hard": the best child at every level; ties go to the first in row order, as in the
        authors' code. "soft": the expectation of a walk that takes children with probabilities
        in the ratio of score^(1 / temperature). "straight-through": the hard walk's value, the
        soft one's gradient.
      temperature: of the soft walk, without unit: a gain of the image hardly changes it.
      children: per axis (K in the paper), around the 2 x 2 cells below a cell. With more than two
        the blocks of neighbouring cells overlap and keypoints may coincide.

    Raises:
      ValueError: no level, levels of other ratios, an odd or too small `children`.
    """
    _check(scores, children)
    if variant == "hard":
        return _hard(scores, row, col, children).astype(jnp.float32)
    soft = expectation(walk(scores, row, col, temperature=temperature, children=children))
    if variant == "soft":
        return soft
    if variant != "straight-through":
        raise ValueError(
            f"relocalize: variant must be 'hard', 'soft' or 'straight-through'; got {variant!r}"
        )
    hard = _hard(scores, row, col, children).astype(soft.dtype)
    return hard + (soft - lax.stop_gradient(soft))


def _hard(
    scores: Sequence[Float[Array, "_h _w"]],
    row: Int[Array, " m"],
    col: Int[Array, " m"],
    children: int,
) -> Int[Array, "m 2"]:
    """The levels differ in shape, which `lax.scan` does not allow; laid end to end in one vector
    they can be scanned over by (offset, rows, columns)."""
    shapes = [level.shape for level in scores]
    starts = [sum(h * w for h, w in shapes[:k]) for k in range(len(shapes))]
    levels = jnp.asarray([(s, *hw) for s, hw in zip(starts, shapes, strict=True)], jnp.int32)
    flat = jnp.concatenate([level.reshape(-1) for level in scores])
    steps = jnp.arange(children, dtype=jnp.int32) + _first_child(children)
    child_row, child_col = jnp.repeat(steps, children), jnp.tile(steps, children)

    def descend(cell, level):
        offset, height, width = level
        rows = FACTOR * cell[0][:, None] + child_row
        cols = FACTOR * cell[1][:, None] + child_col
        found = jnp.take(flat, offset + rows * width + cols, mode="clip")
        if children > FACTOR:  # blocks reach past the borders
            inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
            found = jnp.where(inside, found, -jnp.inf)
        best = jnp.argmax(found, axis=1)
        pick = jnp.arange(best.shape[0])
        return (rows[pick, best], cols[pick, best]), None

    (row, col), _ = lax.scan(descend, (row, col), tuple(levels.T))
    return jnp.stack([col, row], axis=-1)


def walk(
    scores: Sequence[Float[Array, "_h _w"]],
    row: Int[Array, " m"],
    col: Int[Array, " m"],
    *,
    temperature: Float[Array, ""] | float = 1.0,
    children: int = FACTOR,
) -> WalkProbabilities:
    """Where a random walk ends that takes every child with a probability in the ratio of
    score^(1 / temperature) within its block; arguments as `relocalize`."""
    _check(scores, children, temperature)
    first = _first_child(children)
    p = jnp.ones((row.shape[0], 1, 1), scores[0].dtype)
    row0, col0 = row, col
    for level in scores:
        child_p = _child_probabilities(level, row0, col0, p.shape[1], temperature, children)
        size = FACTOR * (p.shape[1] - 1) + children
        below = jnp.zeros((p.shape[0], size, size), p.dtype)
        for i in range(children):
            for j in range(children):
                rows = slice(i, i + 2 * p.shape[1] - 1, 2)
                cols = slice(j, j + 2 * p.shape[1] - 1, 2)
                below = below.at[:, rows, cols].add(p * child_p[..., i * children + j])
        p = below
        row0, col0 = FACTOR * row0 + first, FACTOR * col0 + first
    return WalkProbabilities(p, jnp.stack([col0, row0], axis=-1))


def _child_probabilities(
    level: Float[Array, "h w"],
    row0: Int[Array, " m"],
    col0: Int[Array, " m"],
    size: int,
    temperature: Float[Array, ""] | float,
    children: int,
) -> Float[Array, "m s s k"]:
    """Of the children of every cell in windows of `size` that start at (row0, col0)."""
    first = _first_child(children)
    window = jnp.arange(FACTOR * (size - 1) + children, dtype=row0.dtype) + first
    rows = FACTOR * row0[:, None] + window
    cols = FACTOR * col0[:, None] + window
    h, w = level.shape
    clipped = (jnp.clip(rows, 0, h - 1)[:, :, None], jnp.clip(cols, 0, w - 1)[:, None, :])
    logit = jnp.log(level + LEAST_SCORE)[clipped]
    inside = ((rows >= 0) & (rows < h))[:, :, None] & ((cols >= 0) & (cols < w))[:, None, :]
    last = 2 * size - 1
    blocks = [
        (slice(None), slice(i, i + last, 2), slice(j, j + last, 2))
        for i in range(children)
        for j in range(children)
    ]
    logits = jnp.stack([logit[block] for block in blocks], axis=-1)
    reached = jnp.stack([inside[block] for block in blocks], axis=-1)
    # The best is 0 before the division: any temperature is cold enough, none too cold.
    best = jnp.max(logits, axis=-1, keepdims=True, where=reached, initial=-jnp.inf)
    logits = (logits - lax.stop_gradient(best)) / temperature
    return jax.nn.softmax(logits, axis=-1, where=reached)


def expectation(walks: WalkProbabilities) -> Float[Array, "m 2"]:
    """Mean (x, y) of where walks end, in cells of the finest map."""
    index = jnp.arange(walks.p.shape[1], dtype=walks.p.dtype)
    x = jnp.sum(walks.p * index, axis=(1, 2))
    y = jnp.sum(walks.p * index[:, None], axis=(1, 2))
    return walks.start.astype(walks.p.dtype) + jnp.stack([x, y], axis=-1)


def window_positions(walks: WalkProbabilities) -> Float[Array, "m n 2"]:
    """(x, y) of every cell of the windows in row order, as `walks.p` flattened."""
    size = walks.p.shape[1]
    index = jnp.arange(size, dtype=walks.p.dtype)
    offsets = jnp.stack([jnp.tile(index, size), jnp.repeat(index, size)], axis=-1)
    return walks.start[:, None].astype(walks.p.dtype) + offsets
