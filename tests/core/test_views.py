"""Laws of the views that relocalizers are trained on."""

import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import rng_of, seeds

from jaxsfm.core.night import blur, night
from jaxsfm.core.views import change_light, random_homography, sample_view, view_pair, warp_points
from jaxsfm.synthetic import photo_textures

pair_of = jax.jit(functools.partial(view_pair, size=96))


@pytest.fixture(scope="module")
def photo() -> jax.Array:
    return jnp.asarray(photo_textures()[0][100:300, 100:300], jnp.float32)


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_the_second_view_is_the_first_one_mapped(photo, seed):
    """Both without light: what the first shows, warped by h, is what the second shows."""
    rng = rng_of(seed)
    keys = jax.random.split(jax.random.key(seed), 2)
    place = jnp.asarray([[1.0, 0, 100 - 48], [0, 1, 100 - 48], [0, 0, 1]])
    unit = jnp.asarray([[1 / 48.0, 0, -1], [0, 1 / 48.0, -1], [0, 0, 1]])
    about = jnp.asarray([[48.0, 0, 100], [0, 48.0, 100], [0, 0, 1]])
    h1 = about @ random_homography(keys[0], jnp.float32(0.5)) @ unit
    first, second = (sample_view(photo, h, size=96) for h in (place, h1))
    h = np.asarray(jnp.linalg.inv(h1) @ place, np.float64)
    warped = cv2.warpPerspective(np.asarray(first), h, (96, 96), flags=cv2.INTER_LINEAR)
    seen = cv2.warpPerspective(np.ones((96, 96), np.float32), h, (96, 96)) > 0.999
    seen[:2], seen[-2:], seen[:, :2], seen[:, -2:] = False, False, False, False
    if seen.sum() < 500:
        return
    apart = np.abs(warped - np.asarray(second))[seen]
    wrong = np.abs(warped - np.asarray(jnp.roll(second, 3, axis=1)))[seen]
    assert apart.mean() < 0.5 * wrong.mean()
    del rng


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_pairs_depend_on_their_key_alone_and_are_whole_numbers(photo, seed):
    key = jax.random.key(seed)
    a, b = pair_of(key, photo), pair_of(key, photo)
    together = jax.vmap(pair_of, in_axes=(0, None))(jax.random.split(key, 2), photo)
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)
    assert not np.array_equal(together.h[0], together.h[1])
    for view in a[:2]:
        assert float(view.min()) >= 0 and float(view.max()) <= 255
        np.testing.assert_array_equal(view, jnp.round(view))


def test_no_strength_changes_nothing(photo):
    nothing = jnp.float32(0)
    key = jax.random.key(0)
    np.testing.assert_array_equal(random_homography(key, nothing), np.eye(3))
    np.testing.assert_allclose(change_light(key, photo, nothing), photo, atol=0.05)
    np.testing.assert_array_equal(night(key, photo, nothing), photo)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_homographies_keep_the_view_in_front_and_upright(seed):
    h = np.asarray(random_homography(jax.random.key(seed), jnp.float32(1.0)), np.float64)
    corners = np.asarray([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64)
    assert (np.c_[corners, np.ones(4)] @ h[2] > 0.5).all()
    moved = np.asarray(warp_points(jnp.asarray(h, jnp.float32), jnp.asarray(corners, jnp.float32)))
    x, y = (moved - moved.mean(0)).T
    turned = np.unwrap(np.arctan2(y, x))
    assert turned[3] > turned[0]  # same sense: no mirror


@settings(max_examples=10, deadline=None)
@given(st.floats(0.4, 1.3))
def test_blur_is_a_gaussian(photo, sigma):
    ours = blur(photo, jnp.float32(sigma))
    theirs = cv2.GaussianBlur(np.asarray(photo), (9, 9), sigma, borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(ours, theirs, atol=0.01)


def test_nights_get_darker_and_noisier_with_severity(photo):
    nights = [night(jax.random.key(1), photo, jnp.float32(s)) for s in (1.0, 2.0, 3.0)]
    noise = [float(jnp.abs(n - blur(n, jnp.float32(1.0))).mean() / n.mean()) for n in nights]
    assert float(nights[0].mean()) < float(photo.mean())
    assert noise[0] < noise[1] < noise[2]
    assert all(float(n.min()) >= 0 and float(n.max()) <= 255 for n in nights)
