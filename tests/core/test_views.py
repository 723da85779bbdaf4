"""Laws of the views that relocalizers are trained on."""

import functools

import cv2
import jax
import numpy as np
import pytest
from compiled import compiled
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import seeds

from jaxsfm.bench.synthetic import photo_textures
from jaxsfm.core import night as night_model
from jaxsfm.core import views
from jaxsfm.core.views import change_light, view_pair

random_homography, warp_points = compiled(views.random_homography), compiled(views.warp_points)
sample_view = compiled(views.sample_view, "size")
blur, night = compiled(night_model.blur), compiled(night_model.night)
pair_of = jax.jit(functools.partial(view_pair, size=96))


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    return np.float32(photo_textures()[0][100:300, 100:300])


@pytest.mark.slow
def test_the_second_view_is_the_first_one_mapped(photo, monkeypatch):
    """Without light: what the first shows, warped by h, is what the second shows."""
    monkeypatch.setattr(views, "change_light", lambda key, rgb, strength: rgb)
    monkeypatch.setattr(views, "NIGHT_SHARE", 0.0)
    pairs = jax.jit(jax.vmap(functools.partial(view_pair, size=96), in_axes=(0, None)))(
        jax.random.split(jax.random.key(0), 12), photo
    )
    compared = 0
    for first, second, h in zip(*(np.asarray(part) for part in pairs), strict=True):
        h = h.astype(np.float64)
        warped = cv2.warpPerspective(first, h, (96, 96), flags=cv2.INTER_LINEAR)
        seen = cv2.warpPerspective(np.ones((96, 96), np.float32), h, (96, 96)) > 0.999
        if seen.sum() < 1000:
            continue
        compared += 1
        apart = np.abs(warped - second)[seen].mean()
        for shift in ((0, 3), (3, 0)):
            assert apart < 0.7 * np.abs(warped - np.roll(second, shift, axis=(0, 1)))[seen].mean()
    assert compared >= 6


def test_views_sample_the_photo_where_the_homography_says(photo):
    """At whole pixels: the mean of four samples around each, a 3 x 3 filter."""
    shift = np.float32([[1.0, 0, 30], [0, 1, 50], [0, 0, 1]])
    view = sample_view(photo, shift, size=96)
    kernel = np.outer([1, 6, 1], [1, 6, 1]) / 64
    expected = cv2.filter2D(photo, -1, kernel)[50:146, 30:126]
    np.testing.assert_allclose(view, expected, atol=1e-2)
    shift[:2, 2] = 500
    beyond = sample_view(photo, shift, size=96)
    np.testing.assert_allclose(beyond, np.broadcast_to(photo[-1, -1], beyond.shape), atol=0.5)


@pytest.mark.slow
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
        np.testing.assert_array_equal(view, np.round(view))


def test_views_lie_around_the_middle_of_the_photo(monkeypatch):
    """Of a photo whose values are the columns of its pixels: their mean over many first views."""
    monkeypatch.setattr(views, "change_light", lambda key, rgb, strength: rgb)
    monkeypatch.setattr(views, "night", lambda key, rgb, severity: rgb)
    side = 40
    ramp = np.tile(6 * np.arange(side, dtype=np.float32)[None, :, None], (side, 1, 3))
    draw = compiled(
        jax.vmap(lambda key, photo: view_pair(key, photo, size=9).view0[4, 4, 0] / 6, (0, None))
    )
    middle = draw(jax.random.split(jax.random.key(1), 400), ramp)
    assert abs(middle.mean() - (side - 1) / 2) < 0.2  # six times the deviation of the mean


@pytest.mark.slow
def test_no_strength_changes_nothing(photo):
    nothing = np.float32(0)
    key = jax.random.key(0)
    np.testing.assert_array_equal(random_homography(key, nothing), np.eye(3))
    np.testing.assert_allclose(compiled(change_light)(key, photo, nothing), photo, atol=0.05)
    np.testing.assert_array_equal(night(key, photo, nothing), photo)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_homographies_keep_the_view_in_front_and_upright(seed):
    h = random_homography(jax.random.key(seed), np.float32(1.0)).astype(np.float64)
    corners = np.asarray([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64)
    assert (np.c_[corners, np.ones(4)] @ h[2] > 0.5).all()
    moved = warp_points(np.float32(h), np.float32(corners))
    x, y = (moved - moved.mean(0)).T
    turned = np.unwrap(np.arctan2(y, x))
    assert turned[3] > turned[0]  # same sense: no mirror


@settings(max_examples=10, deadline=None)
@given(st.floats(0.4, 1.3))
def test_blur_is_a_gaussian(photo, sigma):
    ours = blur(photo, np.float32(sigma))
    theirs = cv2.GaussianBlur(photo, (9, 9), sigma, borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(ours, theirs, atol=0.01)


def test_nights_get_darker_and_noisier_with_severity(photo):
    nights = [night(jax.random.key(1), photo, np.float32(s)) for s in (1.0, 2.0, 3.0)]
    noise = [np.abs(n - blur(n, np.float32(1.0))).mean() / n.mean() for n in nights]
    assert float(nights[0].mean()) < float(photo.mean())
    assert noise[0] < noise[1] < noise[2]
    assert all(float(n.min()) >= 0 and float(n.max()) <= 255 for n in nights)
