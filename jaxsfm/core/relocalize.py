"""Keypoint relocalization: every fine cell walks down the pyramid to one pixel.

The walk leads from a pool3 cell to the child with the largest score in pool2, then in pool1, then
in conv1_2. The score is the norm of the descriptor (paper, section 3.2) or a learned one
(`jaxsfm.core.scores`). The walk depends on one image alone. So a keypoint has the index of its cell
in every pair, and tracks are consistent by construction. With 2 x 2 children, different cells have
different children, and two keypoints never coincide.

In a random walk a child is taken with a probability that grows with its score. The expectation of
where it ends is continuous and differentiable (the variant "soft"). As the temperature falls, it
becomes the hard walk.

Scores are positive, and the hard walk uses only their order within a block. Squared norms have the
same order as norms.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsfm.core.numerics import at_least_float32

FACTOR = 2
"""Ratio of neighbouring levels."""
LEAST_SCORE = 1e-3
"""Added to scores before their logarithm, so that blocks of zeros have finite gradients. Squared
norms are around 10 in conv1_2 and around 1000 in pool2."""

Variant = Literal["hard", "soft", "straight-through"]


class WalkProbabilities(NamedTuple):
    """The probabilities of where random walks end: a window of the finest map for every cell."""

    p: Float[Array, "m s s"]
    """Probability of each cell (row, column) of the window; they sum to 1."""
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
    """Offset of the first child from 2 x cell, along an axis with `children` children."""
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
    """The place (x, y) that every cell walks to, in cells of the finest map.

    These are pixels if that map has the size of the image; otherwise
    `jaxsfm.core.grid.cell_to_px` turns them into pixels.

    Args:
      scores: positive score maps, coarse to fine, each twice the size of the last; the first one
        is twice the size of the map that (row, col) are cells of. One map for every level.
      row, col: the cells. The result is unspecified for cells whose children lie outside the maps.
      variant: "hard" takes the best child at every level; ties go to the first in row order, as in
        the authors' code. "soft" gives the expectation of a walk that takes children with
        probabilities proportional to score^(1 / temperature). "straight-through" has the value of
        the hard walk and the gradient of the soft one.
      temperature: of the soft walk; it has no unit, and a gain of the image hardly changes it.
      children: number of children per axis (K in the paper), around the 2 x 2 cells below a cell.
        With more than two, the blocks of neighbouring cells overlap and keypoints may coincide.

    Raises:
      ValueError: there is no level, the sizes of levels do not double, or `children` is odd or
        below 2.
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
    """The hard walk, as a scan over the levels.

    `lax.scan` does not allow levels of different shapes. So they are laid end to end in one vector
    and scanned over by (offset, rows, columns).
    """
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
        best = jnp.argmax(found, axis=1).astype(jnp.int32)
        pick = jnp.arange(best.shape[0], dtype=jnp.int32)
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
    """Where a random walk ends that takes the children of a block with probabilities proportional
    to score^(1 / temperature). Arguments are those of `relocalize`.

    Scores of 16 bits are converted to float32 first, because places are computed from the
    probabilities.
    """
    _check(scores, children, temperature)
    first = _first_child(children)
    levels = [at_least_float32(level) for level in scores]
    p = jnp.ones((row.shape[0], 1, 1), levels[0].dtype)
    row0, col0 = row, col
    for level in levels:
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
    """Probabilities of the k children of every cell in windows of `size` x `size` cells that start
    at (row0, col0)."""
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
    # The best child has the logit 0 before the division, so no temperature is too low.
    best = jnp.max(logits, axis=-1, keepdims=True, where=reached, initial=-jnp.inf)
    logits = (logits - lax.stop_gradient(best)) / temperature
    return jax.nn.softmax(logits, axis=-1, where=reached)


def expectation(walks: WalkProbabilities) -> Float[Array, "m 2"]:
    """Mean place (x, y) where walks end, in cells of the finest map."""
    p = at_least_float32(walks.p)
    index = jnp.arange(p.shape[1], dtype=p.dtype)
    x = jnp.sum(p * index, axis=(1, 2))
    y = jnp.sum(p * index[:, None], axis=(1, 2))
    return walks.start.astype(p.dtype) + jnp.stack([x, y], axis=-1)


def window_positions(walks: WalkProbabilities) -> Float[Array, "m n 2"]:
    """(x, y) of every cell of the windows, in the row order of the flattened `walks.p`."""
    size, dtype = walks.p.shape[1], at_least_float32(walks.p).dtype
    index = jnp.arange(size, dtype=dtype)
    offsets = jnp.stack([jnp.tile(index, size), jnp.repeat(index, size)], axis=-1)
    return walks.start[:, None].astype(dtype) + offsets
