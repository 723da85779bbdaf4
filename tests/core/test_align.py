"""Laws of sub-pixel alignment, on textures that are known everywhere."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled
from hypothesis import given, settings
from strategies import rng_of, seeds
from tolerances import ALIGNED_PX

from jaxsfm.core import align as core
from jaxsfm.core import interpolate

align, make_templates = compiled(core.align, "iterations"), compiled(core.make_templates)
square_patch = compiled(core.square_patch, "radius")
sample, sample_linear = compiled(interpolate.sample), compiled(interpolate.sample_linear)
SIZE = (64, 80)
PATCH = square_patch(radius=7)


def texture(rng, channels: int = 1):
    """A smooth random function of (x, y), periods of 8 pixels and more."""
    waves = rng.uniform(-2 * np.pi / 8, 2 * np.pi / 8, (12, 2))
    phase, size = rng.uniform(0, 2 * np.pi, 12), rng.uniform(10, 30, (12, channels))
    return lambda xy: 120 + np.cos(xy @ waves.T + phase) @ size


def grid():
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack([x, y], -1).astype(np.float64)


def small_affine(rng) -> np.ndarray:
    return np.eye(2) + rng.uniform(-0.25, 0.25, (2, 2))


def views(rng, *, channels: int = 1):
    """A reference view, another one that shows it through x -> a (x - ref) + truth, and those."""
    f = texture(rng, channels)
    ref = np.asarray([40.0, 32.0])
    a, truth = small_affine(rng), ref + rng.uniform(-3, 3, 2)
    back = np.linalg.inv(a)
    return f(grid()), f((grid() - truth) @ back.T + ref), ref, a, truth


def run(one, two, ref, a, start, *, patch=PATCH, size=SIZE, **options):
    size = np.int32(size)
    one, two, ref, start, a = map(np.float32, (one, two, ref[None], start[None], a[None]))
    templates = make_templates(one, size, ref, patch)
    return align(two, size, templates, start, a, patch, **options)


def error(result, truth) -> float:
    return float(np.linalg.norm(np.asarray(result.xy[0]) - truth))


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_a_known_warp_is_found_to_hundredths_of_a_pixel(seed):
    rng = rng_of(seed)
    one, two, ref, a, truth = views(rng)
    result = run(one, two, ref, a, truth + rng.uniform(-1, 1, 2))
    assert result.converged[0] and error(result, truth) < ALIGNED_PX
    assert result.score[0] > 0.99 and result.sigma[0] < 0.1


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_it_converges_from_two_pixels_away(seed):
    """A quarter of the shortest period: beyond, another valley may be nearer."""
    rng = rng_of(seed)
    one, two, ref, a, truth = views(rng)
    angle = rng.uniform(0, 2 * np.pi)
    start = truth + 2 * np.asarray([np.cos(angle), np.sin(angle)])
    assert error(run(one, two, ref, a, start), truth) < ALIGNED_PX


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_gain_and_offset_change_nothing(seed):
    rng = rng_of(seed)
    one, two, ref, a, truth = views(rng)
    plain = run(one, two, ref, a, truth + 0.7)
    changed = run(one, 0.2 * two + 40, ref, a, truth + 0.7)
    np.testing.assert_allclose(changed.xy, plain.xy, atol=2e-3)
    np.testing.assert_allclose(changed.score, plain.score, atol=1e-3)
    negative = run(one, 200 - two, ref, a, truth)
    assert negative.score[0] < 0.9  # a negative gain is another surface


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_on_equal_frames_opencvs_ecc_ends_at_the_same_place(seed):
    rng = rng_of(seed)
    f, ref = texture(rng), np.asarray([40.0, 32.0])
    shift = rng.uniform(-1, 1, 2)
    one, two = f(grid())[..., 0], f(grid() - shift)[..., 0]
    result = run(one[..., None], two[..., None], ref, np.eye(2), ref)
    crop = np.float32(one[32 - 7 : 32 + 8, 40 - 7 : 40 + 8])
    warp = np.float32([[1, 0, 33], [0, 1, 25]])
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-8)
    _, warp = cv2.findTransformECC(
        crop, np.float32(two), warp, cv2.MOTION_TRANSLATION, stop, np.ones_like(two, np.uint8), 1
    )
    ecc = warp[:, 2] + 7
    np.testing.assert_allclose(np.asarray(result.xy[0]), ecc, atol=2 * ALIGNED_PX)


def test_flat_patches_stay_where_they_are_and_do_not_count():
    flat = np.full((*SIZE, 1), 7.0)
    rng = rng_of(1)
    one, two, ref, a, _ = views(rng)
    start = np.asarray([40.3, 30.2])
    for first, second in ((flat, two), (one, flat), (flat, flat)):
        result = run(first, second, ref, a, start)
        assert not result.converged[0] and np.isfinite(np.asarray(result.xy)).all()
    np.testing.assert_allclose(run(flat, two, ref, a, start).xy[0], start, atol=1e-5)


def test_an_edge_tells_its_direction_only():
    """A straight edge leaves the shift along it open: the deviation says so."""
    edge = np.tanh((grid()[..., :1] - 40.3) / 2)
    corner = edge + np.tanh((grid()[..., 1:] - 32.2) / 2)
    noise = rng_of(0).normal(0, 0.02, (2, *SIZE, 1))
    ref = np.asarray([40.0, 32.0])
    sharp = run(corner + noise[0], corner + noise[1], ref, np.eye(2), ref)
    blind = run(edge + noise[0], edge + noise[1], ref, np.eye(2), ref)
    assert sharp.sigma[0] < 0.05 < 5 * sharp.sigma[0] < blind.sigma[0]


def test_the_stated_deviation_is_the_real_one():
    """Noise in both views; the mean square of error / sigma is that of two coordinates at most.

    A law of many textures: on one in some hundreds noise passes for texture, and a dozen errors of
    it are three times what is stated (seed 485).
    """
    every = []
    for seed in range(60):
        rng = rng_of(seed)
        f, ref = texture(rng), np.asarray([40.0, 32.0])
        one = f(grid())
        ratios = []
        for _ in range(12):
            noisy = one + rng.normal(0, 6, one.shape), one + rng.normal(0, 6, one.shape)
            result = run(*noisy, ref, np.eye(2), ref)
            ratios.append(error(result, ref) / float(result.sigma[0]))
        every.append(np.mean(np.square(ratios)))
    assert 0.7 < np.sqrt(np.mean(every)) < 1.1 * np.sqrt(2)  # measured: 1.31
    assert np.sqrt(np.max(every)) < 2  # measured: 1.73


def test_what_looks_like_gain_or_offset_is_no_information():
    """Templates' derivatives have no part along the patch itself (gain) or a constant (offset)."""
    one, _, ref, _, _ = views(rng_of(11), channels=3)
    at = np.float32([ref, ref + 3.5])
    t = make_templates(np.float32(one), np.int32(SIZE), at, PATCH)
    values, descent = np.asarray(t.values, np.float64), np.asarray(t.descent, np.float64)
    w, size = np.asarray(PATCH.weights), np.abs(descent).max()
    np.testing.assert_allclose(np.einsum("q,nqck->nck", w, descent) / size, 0, atol=1e-6)
    along = np.einsum("q,nqc,nqck->nk", w, values, descent)
    np.testing.assert_allclose(along / size, 0, atol=1e-6)
    hessian = np.einsum("q,nqck,nqcl->nkl", w, descent, descent)
    np.testing.assert_allclose(t.hessian, hessian, rtol=1e-4)


def test_a_shift_that_is_only_a_change_of_gain_leaves_the_place_open():
    """exp(x / 5) moved along x is itself times a number: nothing tells where it lies along x."""
    x, y = grid()[..., 0], grid()[..., 1]
    image = np.exp((x - 40) / 5) * (2 + np.cos(y / 2))
    t = make_templates(
        np.float32(image[..., None]), np.int32(SIZE), np.float32([[40.0, 32.0]]), PATCH
    )
    hessian = np.asarray(t.hessian[0])
    assert hessian[0, 0] < 1e-3 * hessian[1, 1]


def test_templates_descend_as_their_values_do():
    """The derivative, from the texture's own: per pixel, before gain and offset are taken out."""
    rng = rng_of(12)
    f, ref = texture(rng), np.asarray([40.0, 32.0])
    t = make_templates(np.float32(f(grid())), np.int32(SIZE), np.float32(ref[None]), PATCH)
    places = ref + np.asarray(PATCH.offsets, np.float64)
    w = np.asarray(PATCH.weights, np.float64)
    values = f(places)
    values -= w @ values
    contrast = np.sqrt(w @ values**2)[0]
    steps = np.eye(2) * 1e-4
    slope = np.stack([(f(places + s) - f(places - s)) / 2e-4 for s in steps], -1) / contrast
    values /= contrast
    slope -= np.einsum("q,qck->ck", w, slope)
    slope -= values[..., None] * np.einsum("q,qc,qck->k", w, values, slope)
    np.testing.assert_allclose(t.contrast[0], contrast, rtol=1e-3)
    np.testing.assert_allclose(t.values[0], values, atol=0.01)
    # Differences over a pixel are the slope of a texture of periods of 8 pixels within a tenth.
    apart = np.linalg.norm(np.asarray(t.descent[0]) - slope) / np.linalg.norm(slope)
    assert apart < 0.1 and t.inside[0]


def test_patches_that_leave_the_image_do_not_count():
    one, two, ref, a, truth = views(rng_of(2))
    assert not run(one, two, np.asarray([3.0, 30.0]), a, truth).converged[0]
    assert not run(one, two, ref, a, np.asarray([78.0, 30.0])).converged[0]


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_several_channels_and_padding_give_what_they_should(seed):
    rng = rng_of(seed)
    one, two, ref, a, truth = views(rng, channels=5)
    plain = run(one, two, ref, a, truth + 0.5)
    assert error(plain, truth) < ALIGNED_PX
    wide = [np.pad(v, ((0, 9), (0, 5), (0, 0)), constant_values=1e3) for v in (one, two)]
    padded = run(*wide, ref, a, truth + 0.5)
    np.testing.assert_allclose(padded.xy, plain.xy, atol=1e-5)


def test_a_batch_is_its_members():
    rng = rng_of(5)
    one, two, ref, a, truth = views(rng)
    starts = truth + rng.uniform(-1, 1, (6, 2))
    size, refs = np.int32(SIZE), np.float32(np.tile(ref, (6, 1)))
    templates = make_templates(np.float32(one), size, refs, PATCH)
    affine = np.float32(np.tile(a, (6, 1, 1)))
    batch = align(np.float32(two), size, templates, np.float32(starts), affine, PATCH)
    for k, start in enumerate(starts):
        alone = run(one, two, ref, a, start)
        np.testing.assert_allclose(batch.xy[k], alone.xy[0], atol=1e-4)


def test_sampling_is_exact_on_pixels_and_parabolas_and_clamped_outside():
    rng = rng_of(0)
    image = np.float32(rng.normal(size=(5, 6, 2)))
    size = np.int32([5, 6])
    at = np.float32([[0.0, 0.0], [5.0, 4.0], [2.0, 3.0], [-3.0, 2.0], [7.0, 9.0]])
    values, inside = sample(image, size, at)
    np.testing.assert_array_equal(np.asarray(inside), [True, True, True, False, False])
    np.testing.assert_allclose(values[0], image[0, 0])
    np.testing.assert_allclose(values[1], image[4, 5], rtol=1e-6)
    np.testing.assert_allclose(values[2], image[3, 2], rtol=1e-6)
    np.testing.assert_allclose(values[3], image[2, 0], rtol=1e-6)
    np.testing.assert_allclose(values[4], image[4, 5], rtol=1e-6)
    y, x = np.mgrid[:9, :9].astype(np.float32)
    parabola = np.float32(0.3 * x * x - y * y + x * y)[..., None]
    at = np.float32([[2.3, 4.8], [5.5, 3.25]])
    want = 0.3 * at[:, 0] ** 2 - at[:, 1] ** 2 + at[:, 0] * at[:, 1]
    got = sample(parabola, np.int32([9, 9]), at)[0][:, 0]
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_bilinear_sampling_is_exact_on_pixels_and_planes_and_clamped_outside():
    rng = rng_of(0)
    image = np.float32(rng.normal(size=(5, 6, 2)))
    size = np.int32([4, 5])  # the last row and column are padding
    at = np.float32([[0.0, 0.0], [4.0, 3.0], [-3.0, 2.0], [7.0, 9.0], [3.5, 0.25]])
    got = sample_linear(image, size, at)
    want = np.stack([image[0, 0], image[3, 4], image[2, 0], image[3, 4]])
    np.testing.assert_allclose(got[:4], want, rtol=1e-6)
    between = 0.375 * image[0, 3:5].sum(0) + 0.125 * image[1, 3:5].sum(0)
    np.testing.assert_allclose(got[4], between, rtol=1e-5)


@jax.jit
def pixels_slopes_and_samples(image, size, at, outside):
    """Of a map, at whole pixels; samples half a pixel around them, by axis; pixels outside."""
    place = at.astype(jnp.float32)
    half = 0.5 * np.eye(2, dtype=np.float32)
    around = [[interpolate.sample(image, size, place + s * h)[0] for s in (1, -1)] for h in half]
    return (
        interpolate.pixels(image, size, at, jnp.float32),
        interpolate.sample(image, size, place)[0],
        interpolate.slopes(image, size, at, jnp.float32),
        around,
        interpolate.pixels(image, size, outside, jnp.float32),
    )


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_pixels_and_slopes_are_what_cubic_sampling_gives(seed):
    """Inside; a slope at the edge would look outside."""
    rng = rng_of(seed)
    image, size = np.float32(rng.normal(size=(9, 11, 2))), np.int32([9, 11])
    at = np.int32(rng.integers([2, 2], [9, 7], (6, 2)))
    values, sampled, slope, around, outside = jax.device_get(
        pixels_slopes_and_samples(image, size, at, np.int32([[-4, 3], [20, 30]]))
    )
    np.testing.assert_array_equal(values, sampled)
    for axis, (after, before) in enumerate(around):
        np.testing.assert_allclose(slope[..., axis], after - before, atol=1e-5)
    np.testing.assert_array_equal(outside, np.stack([image[3, 0], image[8, 10]]))


def alike_in_part(rng, share: float, count: int):
    """Maps of `count` patches one below the other; the second map shows the texture of the first
    one, shifted, and `share` of another texture. And the places of the patches."""
    one, two = [], []
    for _ in range(count):
        f, other, shift = texture(rng), texture(rng), rng.uniform(-1, 1, 2)
        one.append(f(grid()))
        two.append(f(grid() - shift) + share * (other(grid()) - 120))
    places = np.asarray([[40.0, 32.0 + SIZE[0] * k] for k in range(count)])
    return np.concatenate(one), np.concatenate(two), places


@pytest.mark.parametrize(("share", "least"), [(0.75, 0.94), (1.2, 0.85)])
def test_patches_that_are_alike_only_in_part_converge_as_soon(share, least):
    """Their scores are 0.84 and 0.73. Without corrections of the system, 85 and 63 of 100 come
    within a hundredth of a pixel of where many steps end, instead of 97 and 91."""
    one, two, places = alike_in_part(rng_of(1), share, 96)
    size = np.int32(one.shape[:2])
    one, two, at = map(np.float32, (one, two, places))
    same = np.tile(np.eye(2, dtype=np.float32), (len(places), 1, 1))
    templates = make_templates(one, size, at, PATCH)
    found, end = (
        align(two, size, templates, at + 1.5, same, PATCH, **steps)
        for steps in ({}, {"iterations": 80})
    )
    away = np.linalg.norm(found.xy - end.xy, axis=1)
    assert (away < 0.01).mean() > least


@pytest.mark.slow
def test_where_a_keypoint_ends_follows_the_map_and_its_gradient_is_finite():
    """Moving the whole map by t moves the aligned keypoint by t: d xy / d t = identity."""
    f, ref = texture(rng_of(4)), np.asarray([40.0, 32.0])
    one = jnp.asarray(f(grid()), jnp.float32)
    size = jnp.asarray(SIZE, jnp.int32)
    at = jnp.asarray(ref, jnp.float32)[None]
    affine = jnp.eye(2, dtype=jnp.float32)[None]
    pixels = jnp.asarray(grid(), jnp.float32)

    def end(t, image):
        moved = interpolate.sample(image, size, pixels - t)[0]
        templates = core.make_templates(one, size, at, PATCH)
        return core.align(moved, size, templates, at, affine, PATCH).xy[0]

    jacobian = jax.jacobian(end)(jnp.asarray([0.3, -0.4], jnp.float32), one)
    np.testing.assert_allclose(jacobian, np.eye(2), atol=0.1)
    for image in (one, jnp.zeros_like(one)):
        gradient = jax.grad(lambda m: end(jnp.zeros(2, jnp.float32), m).sum())(image)  # noqa: B023
        assert jnp.isfinite(gradient).all()


def test_gradients_with_respect_to_keypoints_vanish_once_converged():
    """The end does not depend on the start: its derivative is finite and near zero."""
    one, two, ref, a, truth = views(rng_of(6))
    size = np.int32(SIZE)
    templates = make_templates(np.float32(one), size, np.float32(ref[None]), PATCH)

    def end(start):
        image, affine = np.float32(two), np.float32(a[None])
        return core.align(image, size, templates, start[None], affine, PATCH).xy[0]

    jacobian = compiled(jax.jacobian(end))(np.float32(truth + 0.4))
    assert np.isfinite(jacobian).all() and np.abs(jacobian).max() < 0.05


def test_templates_are_normalised_and_a_patch_weighs_one():
    one, _, ref, _, _ = views(rng_of(7), channels=3)
    t = make_templates(np.float32(one), np.int32(SIZE), np.float32(ref[None]), PATCH)
    assert isinstance(t, core.Templates)
    w = PATCH.weights
    np.testing.assert_allclose(w.sum(), 1, rtol=1e-5)
    np.testing.assert_allclose(np.einsum("q,nqc->nc", w, t.values), np.zeros((1, 3)), atol=1e-5)
    np.testing.assert_allclose(np.einsum("q,nqc->n", w, t.values**2), [1.0], rtol=1e-4)
    with pytest.raises(ValueError, match="radius"):
        core.square_patch(0)


@pytest.mark.parametrize("radius", [2, 3])
def test_weights_of_a_patch_fall_like_a_gaussian_around_its_centre(radius):
    patch = square_patch(radius=radius)
    side = 2 * radius + 1
    weights = np.asarray(patch.weights, np.float64).reshape(side, side)
    steps = np.arange(side) - radius
    square = steps[:, None] ** 2 + steps**2
    expected = np.exp(-square / (2 * (radius / 2) ** 2))
    np.testing.assert_allclose(weights, expected / expected.sum(), rtol=1e-5)
    offsets = np.asarray(patch.offsets).reshape(side, side, 2)
    np.testing.assert_array_equal(offsets[..., 0], np.broadcast_to(steps, (side, side)))
    np.testing.assert_array_equal(offsets[..., 1], offsets[..., 0].T)
