"""Laws of alignment under noise, from thousands of patches with known places.

The patches lie side by side in one image, so that one call aligns all of them.
"""

import functools
import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from strategies import rng_of

from jaxsfm.core.align import align, make_templates, square_patch

TEXTURES, SEEDS, TILE, CENTRE = 16, 48, 34, 16
FRACTIONS = [(0.0, 0.0), (0.25, 0.25), (0.5, 0.5), (0.0, 0.5)]
PLACES = np.asarray(list(itertools.product(FRACTIONS, FRACTIONS)))
"""(16, 2, 2): fractions of a pixel of the reference keypoint, and of the keypoint that it is seen
at."""
NOISE = 6.0
"""An eighth of the textures' contrast."""
AFFINE = {
    "the same size": np.eye(2),
    "half the size": np.asarray([[0.6, 0.1], [-0.1, 0.5]]),
    "larger": np.asarray([[1.7, 0.1], [-0.1, 1.5]]),
}


def tiles(seed: int, affine: np.ndarray) -> list[np.ndarray]:
    """Patches without noise, (textures, places, rows, columns) of either view: random functions
    with periods of 8 pixels and more."""
    rng = rng_of(seed)
    waves = rng.uniform(-2 * np.pi / 8, 2 * np.pi / 8, (TEXTURES, 1, 1, 12, 2))
    phase = rng.uniform(0, 2 * np.pi, (TEXTURES, 1, 1, 12))
    size = rng.uniform(10, 30, (TEXTURES, 1, 1, 12))
    pixels = np.stack(np.mgrid[:TILE, :TILE][::-1], -1).reshape(-1, 2) - float(CENTRE)
    back = (pixels - PLACES[:, None, 1]) @ np.linalg.inv(affine).T + PLACES[:, None, 0]
    views = np.broadcast_to(pixels, back.shape), back
    shape = (TEXTURES, len(PLACES), TILE, TILE)
    return [
        (120 + (size * np.cos((xy[None, :, :, None] * waves).sum(-1) + phase)).sum(-1)).reshape(
            shape
        )
        for xy in views
    ]


@functools.cache
def outcome(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors (textures, places, seeds, 2) and stated deviations (textures, places, seeds)."""
    affine, rng = AFFINE[name], rng_of(1)
    shape = (TEXTURES, len(PLACES), SEEDS)
    count, across = int(np.prod(shape)), TEXTURES * SEEDS
    images = []
    for clean in tiles(0, affine):
        noise = rng.normal(0, NOISE, (*shape, TILE, TILE)).astype(np.float32)
        every = (clean[:, :, None] + noise).reshape(-1, across, TILE, TILE)
        images.append(np.float32(every.swapaxes(1, 2).reshape(-1, across * TILE, 1)))
    column, row = np.arange(count) % across, np.arange(count) // across
    corner = np.stack([column, row], -1) * TILE + CENTRE
    place = np.broadcast_to(PLACES[None, :, None], (*shape, 2, 2)).reshape(-1, 2, 2)
    ref, truth = corner + place[:, 0], corner + place[:, 1]
    patch, extent = square_patch(7), jnp.asarray(images[0].shape[:2], jnp.int32)
    one, two, ref, start, a = (
        jnp.asarray(x, jnp.float32)
        for x in (*images, ref, truth, np.broadcast_to(affine, (count, 2, 2)))
    )
    found = align(two, extent, make_templates(one, extent, ref, patch), start, a, patch)
    assert np.asarray(found.converged).mean() > 0.99
    errors = np.asarray(found.xy, np.float64) - truth
    return errors.reshape(*shape, 2), np.asarray(found.sigma, np.float64).reshape(shape)


def test_noise_draws_keypoints_between_pixels_to_neither_side():
    """The mean error is a small part of the random one, at every fraction of a pixel."""
    errors, _ = outcome("the same size")
    bias = np.linalg.norm(errors.mean(axis=2), axis=-1)
    spread = np.linalg.norm(errors.std(axis=2), axis=-1)
    assert (np.median(bias / spread, axis=0) < 0.35).all()


@pytest.mark.parametrize("name", AFFINE)
def test_the_stated_deviation_is_the_real_one_at_any_fraction_of_a_pixel(name):
    """Along the worst direction of each texture, which is the same at all places."""
    errors, sigma = outcome(name)
    every = errors.reshape(TEXTURES, -1, 2)
    worst = np.linalg.eigh(np.einsum("tni,tnj->tij", every, every))[1][:, :, 1]
    real = (np.einsum("tpsk,tk->tps", errors, worst) ** 2).mean(axis=2)
    ratio = np.sqrt((real / (sigma**2).mean(axis=2)).mean(axis=0))
    assert (ratio > 1 / 1.2).all() and (ratio < 1.2).all(), ratio
