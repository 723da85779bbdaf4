"""Learned scores for relocalization: which cell of a block is found again in another image.

The score of the paper is the norm of the descriptor. Here it is the squared norm times a positive
factor. The factor of each level is made of a two-layer perceptron of the cell's unit descriptor and
of a table of places within the fine cell,

    s(f, row, column) = |f|^2 exp(v . relu(W f / |f| + b) + q[row mod n, column mod n])

where a fine cell is n = 8, 4, 2 cells of conv1_2, pool1, pool2 wide. The table is there because two
matched cells hardly ever cover the same pixels, and what lies in the middle of one cell lies more
often in the other cell too. With v = 0 and q = 0, as initialised, s is exactly the squared norm. A
gain of the map multiplies all scores alike and moves no keypoint, as with norms.

Other modules take the parameters and not the scores, because the maps of the first levels exist
only strip by strip (`jaxsfm.core.blocks`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsfm.core.grid import FINE_STRIDE
from jaxsfm.core.numerics import HIGHEST, inverse_norm, squared_norm

WALKED: dict[str, int] = {"conv1_2": 64, "pool1": 64, "pool2": 128}
"""Levels that keypoints walk through, fine to coarse, and their channels."""
PLACES: dict[str, int] = {name: FINE_STRIDE >> k for k, name in enumerate(WALKED)}
"""How many cells of a level a fine cell is wide."""
HIDDEN = 32
"""Hidden units of the perceptron of a level."""
MOST_EXPONENT = 30.0
"""Largest logarithm of the factor: scores stay finite, whatever was learned."""


class Head(NamedTuple):
    """The learned parameters of a level."""

    kernel: Float[Array, "c k"]
    bias: Float[Array, " k"]
    out: Float[Array, " k"]
    place: Float[Array, "n n"]


def score(x: Float[Array, "*batch h w c"], head: Head | None) -> Float[Array, "*batch h w"]:
    """The score of every cell of a map, at least 0. Without a head it is the squared norm.

    Args:
      x: the map, or a part of it that starts at the first row and column of a fine cell.
    """
    square = squared_norm(x)
    if head is None:
        return square
    unit = x * inverse_norm(x)[..., None]
    hidden = nn.relu(jnp.matmul(unit, head.kernel, precision=HIGHEST) + head.bias)
    row, col = (jnp.arange(side, dtype=jnp.int32) % head.place.shape[0] for side in x.shape[-3:-1])
    exponent = jnp.matmul(hidden, head.out, precision=HIGHEST) + head.place[row[:, None], col]
    return square * jnp.exp(jnp.clip(exponent, -MOST_EXPONENT, MOST_EXPONENT))


class _Level(nn.Module):
    channels: int
    places: int
    hidden: int

    @nn.compact
    def __call__(self) -> Head:
        """The level's parameters."""
        zeros = nn.initializers.zeros_init()
        spread = nn.initializers.normal(3.0 / self.channels**0.5)
        shapes = (self.channels, self.hidden), (self.hidden,), (self.places, self.places)
        kernel = self.param("kernel", spread, shapes[0], jnp.float32)
        bias = self.param("bias", zeros, shapes[1], jnp.float32)
        out = self.param("out", zeros, shapes[1], jnp.float32)
        place = self.param("place", zeros, shapes[2], jnp.float32)
        return Head(*map(jnp.asarray, (kernel, bias, out, place)))


class Scores(nn.Module):
    """A flax module: `apply(params, maps)` gives a score map each for conv1_2, pool1 and pool2."""

    hidden: int = HIDDEN

    def setup(self) -> None:
        """One head per level."""
        for name, channels in WALKED.items():
            setattr(self, name, _Level(channels, PLACES[name], self.hidden))

    def heads(self) -> tuple[Head, ...]:
        """The heads of all levels, fine to coarse."""
        return tuple(getattr(self, name)() for name in WALKED)

    def __call__(self, maps: Sequence[Float[Array, "*batch _h _w _c"]]) -> tuple[Array, ...]:
        """Score maps of feature maps, both fine to coarse."""
        return tuple(score(x, head) for x, head in zip(maps, self.heads(), strict=True))


def heads_of(params: dict | None) -> tuple[Head | None, ...]:
    """The heads in the parameters of `Scores`, fine to coarse. `None` gives no heads: scores are
    then squared norms."""
    if params is None:
        return (None,) * len(WALKED)
    return tuple(Head(**params["params"][name]) for name in WALKED)


def init_scores(key: Array, *, hidden: int = HIDDEN) -> dict:
    """Parameters that score exactly as squared norms do."""
    maps = [jnp.zeros((1, 1, channels), jnp.float32) for channels in WALKED.values()]
    return dict(Scores(hidden).init(key, maps))
