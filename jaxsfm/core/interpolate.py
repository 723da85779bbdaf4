"""Values between the pixels of a map, by cubic convolution or bilinearly, and how much noise they
keep.

Source: Keys, IEEE ASSP 1981, equation 15 with a = -1/2.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, DTypeLike, Float, Int


def cubic(f: Float[Array, "*n"]) -> list[Float[Array, "*n"]]:
    """Weights of the pixels -1, 0, 1, 2 for a position f in [0, 1] between 0 and 1."""
    return [
        ((-0.5 * f + 1.0) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1.0,
        ((-1.5 * f + 2.0) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    ]


def sample(
    image: Float[Array, "h w c"], size: Int[Array, " 2"], xy: Float[Array, "*n 2"]
) -> tuple[Float[Array, "*n c"], Bool[Array, "*n"]]:
    """Values at (x, y) by cubic convolution, and which of the points lie inside the image.

    A map may have fewer bits than the points (bfloat16). Its values are then converted to the type
    of the points before they are interpolated, because places are computed from them.

    A point outside the image gets the value of the nearest edge. Bilinear interpolation would blur
    most half-way between pixels and draw alignments towards there: they were 0.05 px off on smooth
    textures instead of 0.01 (tests/core/test_align.py).

    Args:
      size: valid (rows, columns) of the map.
    """
    h, w, c = image.shape
    right, bottom = size[1] - 1, size[0] - 1
    x = jnp.clip(xy[..., 0], 0, right.astype(xy.dtype))
    y = jnp.clip(xy[..., 1], 0, bottom.astype(xy.dtype))
    inside = (x == xy[..., 0]) & (y == xy[..., 1])
    x0, y0 = jnp.floor(x), jnp.floor(y)
    columns = [jnp.clip(x0.astype(jnp.int32) + k, 0, right) for k in (-1, 0, 1, 2)]
    rows = [jnp.clip(y0.astype(jnp.int32) + k, 0, bottom) * w for k in (-1, 0, 1, 2)]
    flat = image.reshape(h * w, c)
    across, down = cubic(x - x0), cubic(y - y0)
    total = jnp.zeros((*xy.shape[:-1], c), xy.dtype)
    for row, v in zip(rows, down, strict=True):
        line = sum(
            flat[row + col].astype(xy.dtype) * u[..., None]
            for col, u in zip(columns, across, strict=True)
        )
        total = total + line * v[..., None]
    return total, inside


def sample_linear(
    image: Float[Array, "h w c"], size: Int[Array, " 2"], xy: Float[Array, "*n 2"]
) -> Float[Array, "*n c"]:
    """Values at (x, y) between four pixels instead of the sixteen of `sample`.

    It has the types and edges of `sample`.
    """
    h, w, c = image.shape
    last = size[::-1] - 1
    at = jnp.clip(xy, 0, last.astype(xy.dtype))
    low = jnp.floor(at)
    f = (at - low)[..., None, :]
    first = low.astype(jnp.int32)
    second = jnp.minimum(first + 1, last)
    flat = image.reshape(h * w, c)
    upper, lower = (
        flat[y * w + first[..., 0]].astype(xy.dtype) * (1 - f[..., 0])
        + flat[y * w + second[..., 0]].astype(xy.dtype) * f[..., 0]
        for y in (first[..., 1], second[..., 1])
    )
    return upper * (1 - f[..., 1]) + lower * f[..., 1]


def pixels(
    image: Float[Array, "h w c"], size: Int[Array, " 2"], at: Int[Array, "*n 2"], dtype: DTypeLike
) -> Float[Array, "*n c"]:
    """The pixels (x, y) themselves; outside the image, those of the nearest edge.

    Args:
      dtype: of the values.
    """
    h, w, c = image.shape
    x, y = (jnp.clip(at[..., k], 0, size[1 - k] - 1) for k in (0, 1))
    return image.reshape(h * w, c)[y * w + x].astype(dtype)


def slopes(
    image: Float[Array, "h w c"], size: Int[Array, " 2"], at: Int[Array, "*n 2"], dtype: DTypeLike
) -> Float[Array, "*n c 2"]:
    """Derivatives by x and y at pixels: the differences of the values of `sample` half a pixel
    after and before them, which are weighted sums of four pixels.

    Args:
      dtype: of the derivatives.
    """

    def along(axis: int) -> Float[Array, "*n c"]:
        near = {k: pixels(image, size, at.at[..., axis].add(k), dtype) for k in (-2, -1, 1, 2)}
        return (10 * (near[1] - near[-1]) - (near[2] - near[-2])) / 16

    return jnp.stack([along(0), along(1)], axis=-1)


def noise_kept(xy: Float[Array, "q 2"], weights: Float[Array, " q"]) -> Float[Array, ""]:
    """Weighted mean variance of values sampled at xy, if the pixels have independent noise of
    variance 1. It is 1 on pixels, and 0.41 half-way between them in both directions."""
    f = xy - jnp.floor(xy)
    return jnp.sum(weights * jnp.prod(sum(u * u for u in cubic(f)), axis=-1))


def noise_summed(area: Float[Array, ""], kept: Float[Array, ""]) -> Float[Array, ""]:
    """Sum of the covariances of a sample with all samples around it, for the same noise.

    The weights by which a pixel enters all samples sum to the number of samples per pixel, and the
    weights by which a sample is made of pixels sum to 1. So the sum is the number of samples per
    pixel. Where samples lie so far apart that they share no pixels, only the variance remains.

    Args:
      area: square pixels per sample.
      kept: variance of a sample (`noise_kept`).
    """
    return jnp.maximum(1 / jnp.maximum(area, 1e-6), kept)
