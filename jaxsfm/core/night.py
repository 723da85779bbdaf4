"""A synthetic night for training: the light, blur and photons of `jaxsfm.bench.scenes`, in JAX.

Denoising and JPEG compression, which cameras apply afterwards, are left out. The model does not
replace photos taken at night.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsfm.core.numerics import HIGHEST
from jaxsfm.core.types import PRNGKey

GAMMA = 2.2
AMBIENT = tuple(0.006 * colour for colour in (0.7, 0.85, 1.2))
"""Light of the night sky, RGB; daylight is 1."""
LAMPS = (
    (1.25, 0.9, 0.5),  # sodium
    (1.1, 1.0, 0.8),  # warm white
    (0.85, 1.05, 1.0),  # mercury
)
NUM_LAMPS = 6
SATURATED_SHARE = 0.01
FULL_WELL = 20_000.0
MIN_FULL_SCALE = 100.0
READ_NOISE = 2.0
BLUR_PX = 0.3
BLUR_RADIUS = 4
"""Pixels on either side that a blur reaches: three standard deviations of the widest blur."""


def blur(image: Float[Array, "h w c"], sigma: Float[Array, ""]) -> Float[Array, "h w c"]:
    """Gaussian blur; edges are repeated.

    Args:
      sigma: standard deviation, pixels, at most a third of BLUR_RADIUS; 0 blurs nothing.
    """
    at = jnp.arange(-BLUR_RADIUS, BLUR_RADIUS + 1, dtype=image.dtype)
    taps = jnp.exp(-0.5 * (at / jnp.maximum(sigma, 1e-2)) ** 2)
    taps = taps / jnp.sum(taps)

    def down(x):
        padded = jnp.pad(x, ((BLUR_RADIUS, BLUR_RADIUS), (0, 0), (0, 0)), mode="edge")
        rows = [lax.slice_in_dim(padded, k, k + x.shape[0]) for k in range(len(at))]
        return sum(tap * row for tap, row in zip(taps, rows, strict=True))

    return jnp.swapaxes(down(jnp.swapaxes(down(image), 0, 1)), 0, 1)


def _lamp_light(key: PRNGKey, height: int, width: int) -> tuple[Array, Array]:
    """Light of random lamps on the surfaces (h, w, 3), and their glare (h, w, 3)."""
    diagonal = float(height**2 + width**2) ** 0.5
    y, x = jnp.mgrid[:height, :width].astype(jnp.float32)
    place, reach, colour, strength = jax.random.split(key, 4)
    low, high = (jnp.asarray(x, jnp.float32) for x in ((0.05, 0.05), (0.95, 0.75)))
    at = jax.random.uniform(place, (NUM_LAMPS, 2), jnp.float32, minval=low, maxval=high)
    at = at * jnp.asarray([width, height], jnp.float32)
    reaches = diagonal * jax.random.uniform(
        reach, (NUM_LAMPS,), jnp.float32, minval=0.06, maxval=0.16
    )
    kinds = jax.random.randint(colour, (NUM_LAMPS,), 0, len(LAMPS), jnp.int32)
    colours = jnp.asarray(LAMPS, jnp.float32)[kinds] * jax.random.uniform(
        strength, (NUM_LAMPS, 1), jnp.float32, minval=0.4, maxval=1.0
    )
    square = (x - at[:, 0, None, None]) ** 2 + (y - at[:, 1, None, None]) ** 2
    lit = 1 / (1 + square / reaches[:, None, None] ** 2) ** 2
    flare = jnp.exp(-square / (2 * (0.006 * diagonal) ** 2))
    light = jnp.einsum("khw,kc->hwc", lit, colours, precision=HIGHEST)
    light = light + jnp.asarray(AMBIENT, jnp.float32)
    return light, jnp.einsum("khw,kc->hwc", flare, colours, precision=HIGHEST)


def night(
    key: PRNGKey, rgb: Float[Array, "h w 3"], severity: Float[Array, ""]
) -> Float[Array, "h w 3"]:
    """A photo as a synthetic night shows it, 0 .. 255.

    Args:
      key: fixes the lamps and the noise.
      rgb: the photo, 0 .. 255.
      severity: 0 gives the photo, 1 a clean night, 2 a noisy one, 3 a dark and very noisy one; at
        most 4.
    """
    lamps, photons = jax.random.split(key)
    light, glare = _lamp_light(lamps, *rgb.shape[:2])
    dusk = jnp.minimum(severity, 1.0)
    radiance = (jnp.clip(rgb, 0.0, 255.0) / 255.0) ** GAMMA * ((1 - dusk) + dusk * light)
    radiance = blur(radiance + dusk * glare, BLUR_PX * severity)
    brightest = jnp.max(radiance, axis=2)
    white = (1 - dusk) + dusk * jnp.quantile(brightest, jnp.float32(1 - SATURATED_SHARE))
    full = FULL_WELL * 10.0**-severity
    expected = jnp.minimum(radiance / jnp.maximum(white, 1e-6), 1.0) * full
    # Numbers of photons are drawn from a normal distribution. It is right from ten photons on, and
    # takes a tenth of the time of a Poisson distribution.
    spread = jnp.sqrt(expected + READ_NOISE**2)
    electrons = expected + spread * jax.random.normal(photons, rgb.shape, jnp.float32)
    signal = jnp.clip(electrons / jnp.maximum(full, MIN_FULL_SCALE), 0.0, 1.0)
    return jnp.where(severity > 0, 255.0 * signal ** (1 / GAMMA), rgb)
