"""Training pairs without labels: two views made from one photo, and the map between them.

A crop of a photo is seen through two random homographies. Each view gets its own light, blur and
noise, and some second views a synthetic night. All of it is drawn from the key.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsfm.core.homography import homogeneous
from jaxsfm.core.night import blur, night
from jaxsfm.core.numerics import HIGHEST
from jaxsfm.core.types import PRNGKey

SUPERSAMPLING = 2
"""Samples per pixel and axis. With two, views at half the scale of the photo do not alias."""
NIGHT_SHARE = 0.3
"""Share of second views that are nights."""
MOST_SEVERE = 2.5
"""Largest severity of these nights (`jaxsfm.core.night.night`)."""


class ViewPair(NamedTuple):
    """Two views of one photo."""

    view0: Float[Array, "v v 3"]
    """Whole numbers 0 .. 255, RGB."""
    view1: Float[Array, "v v 3"]
    h: Float[Array, "3 3"]
    """Maps pixels of view 0 to pixels of view 1."""


def warp_points(h: Float[Array, "3 3"], xy: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """Points (x, y) mapped by a homography."""
    moved = jnp.einsum("ij,...j->...i", h, homogeneous(xy), precision=HIGHEST)
    return moved[..., :2] / moved[..., 2:]


def random_homography(key: PRNGKey, strength: Float[Array, ""]) -> Float[Array, "3 3"]:
    """A random homography about the origin, for coordinates in units of half a view's size.

    Args:
      strength: 0 gives the identity. 1 gives scales of 0.55-1.8, rotations of up to 35 deg,
        aspect ratios of 0.7-1.4, a shear of up to 0.3, and a perspective that changes the scale
        across the view by up to a third.
    """
    u = strength * jax.random.uniform(key, (6,), jnp.float32, minval=-1.0, maxval=1.0)
    scale, aspect = jnp.exp(0.6 * u[0]), jnp.exp(0.35 * u[1])
    turn, shear = 0.6 * u[2], 0.3 * u[3]
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    rotation = jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])])
    stretch = jnp.stack(
        [jnp.stack([aspect, shear]), jnp.stack([jnp.zeros_like(aspect), 1 / aspect])]
    )
    affine = scale * jnp.matmul(rotation, stretch, precision=HIGHEST)
    last = jnp.concatenate([0.08 * u[4:], jnp.ones((1,), u.dtype)])
    return jnp.concatenate([jnp.pad(affine, ((0, 0), (0, 1))), last[None]])


def sample_view(
    photo: Float[Array, "s s 3"], h: Float[Array, "3 3"], *, size: int
) -> Float[Array, "v v 3"]:
    """The view of a photo through a homography. A pixel is the mean of several bilinear samples.

    Args:
      h: maps pixels of the view to pixels of the photo; the edge is repeated beyond the photo.
      size: side of the view, pixels.
    """
    n, side = size * SUPERSAMPLING, photo.shape[0]
    at = (jnp.arange(n, dtype=jnp.float32) + 0.5) / SUPERSAMPLING - 0.5
    xy = jnp.stack(jnp.meshgrid(at, at), axis=-1)
    xy = jnp.clip(warp_points(h, xy).reshape(-1, 2), 0.0, side - 1.001)
    low = jnp.floor(xy)
    x, y = (xy - low)[:, :1], (xy - low)[:, 1:]
    flat, index = photo.reshape(-1, 3), (low[:, 1] * side + low[:, 0]).astype(jnp.int32)
    above = flat[index] * (1 - x) + flat[index + 1] * x
    below = flat[index + side] * (1 - x) + flat[index + side + 1] * x
    seen = (above * (1 - y) + below * y).reshape(size, SUPERSAMPLING, size, SUPERSAMPLING, 3)
    return seen.mean(axis=(1, 3))


def change_light(
    key: PRNGKey, rgb: Float[Array, "h w 3"], strength: Float[Array, ""]
) -> Float[Array, "h w 3"]:
    """An image, 0 .. 255, with another exposure, white balance, contrast, focus and sensor noise.

    Args:
      rgb: the image, 0 .. 255.
      strength: 0 changes nothing. 1 draws exposures of e^-1 to e^0.4, gains of channels of up to
        e^0.3, contrasts of up to e^0.4, a blur of up to 1.2 px and noise of up to 6 grey levels.
    """
    exposure, gains, contrast, focus, noisy, noise = jax.random.split(key, 6)

    def draw(key, low, high, shape=()):
        return strength * jax.random.uniform(key, shape, jnp.float32, minval=low, maxval=high)

    linear = (jnp.clip(rgb, 0.0, 255.0) / 255.0) ** 2.2
    linear = linear * jnp.exp(draw(exposure, -1.0, 0.4)) * jnp.exp(draw(gains, -0.3, 0.3, (3,)))
    value = blur(jnp.clip(linear, 0.0, 1.0), draw(focus, 0.0, 1.2)) ** (1 / 2.2)
    value = 255.0 * ((value - 0.5) * jnp.exp(draw(contrast, -0.4, 0.4)) + 0.5)
    value = value + draw(noisy, 0.0, 6.0) * jax.random.normal(noise, rgb.shape, jnp.float32)
    return jnp.clip(value, 0.0, 255.0)


def view_pair(key: PRNGKey, photo: Float[Array, "s s 3"], *, size: int) -> ViewPair:
    """Two views of a square photo. The first is changed little, the second by any homography and
    any light.

    Args:
      photo: RGB, 0 .. 255.
      size: side of the views, pixels. With about half of the photo's side most views stay inside.
    """
    keys = jax.random.split(key, 8)
    half, side = (size - 1) / 2, photo.shape[0]
    to_unit = jnp.asarray([[1 / half, 0, -1], [0, 1 / half, -1], [0, 0, 1]], jnp.float32)

    def view_to_photo(key, place, strength):
        moved = jax.random.uniform(place, (2,), jnp.float32, minval=-0.2, maxval=0.2)
        shift = (side - 1) / 2 + moved * half
        to_photo = (jnp.eye(3, dtype=jnp.float32) * half).at[:2, 2].set(shift).at[2, 2].set(1.0)
        h = jnp.matmul(random_homography(key, strength), to_unit, precision=HIGHEST)
        return jnp.matmul(to_photo, h, precision=HIGHEST)

    h0 = view_to_photo(keys[0], keys[1], jnp.float32(0.2))
    h1 = view_to_photo(keys[2], keys[3], jax.random.uniform(keys[4], (), jnp.float32))
    view0 = change_light(keys[5], sample_view(photo, h0, size=size), jnp.float32(0.5))
    seen = sample_view(photo, h1, size=size)
    dark, severity = jax.random.uniform(keys[6], (2,), jnp.float32)
    view1 = jnp.where(
        dark < NIGHT_SHARE,
        night(keys[7], seen, MOST_SEVERE * severity),
        change_light(keys[7], seen, jnp.float32(1.0)),
    )
    h = jnp.matmul(jnp.linalg.inv(h1), h0, precision=HIGHEST)
    return ViewPair(jnp.round(view0), jnp.round(view1), h)
