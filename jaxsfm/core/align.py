"""Sub-pixel alignment of keypoints.

A patch of the reference view is warped by the local plane and moved over another view until the two
agree up to gain and offset.

Maps are (h, w, c), with c = 1 for intensities and more channels for dense features. They may be
padded at the bottom and on the right beyond `size`. A patch is a list of offsets around a keypoint
with a weight each. All functions are batched by vmap, can be compiled, and are differentiable with
respect to keypoints and maps: the number of iterations is static, and failures are masked.

The gradient of the template is used, so a step is one sampling of the map and the solution of a
2 x 2 system. The first step is that of Gauss-Newton. Where the two patches are alike only in part,
Gauss-Newton goes too far or not far enough, by the same share each time. So every later step
corrects the system by what the step before has really changed (Broyden).

The first steps only bring the patch near, and interpolate bilinearly, from a quarter of the pixels.
The last ones interpolate by cubic convolution, whose places count.

Source: Baker and Matthews, IJCV 2004, section 3.2 (inverse compositional alignment); Broyden,
Mathematics of Computation 1965, "A class of methods for solving nonlinear simultaneous equations"
(his first method, which updates the Jacobian by a matrix of rank one).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.interpolate import (
    noise_kept,
    noise_summed,
    pixels,
    sample,
    sample_linear,
    slopes,
)
from jaxsfm.core.numerics import HIGHEST


class Patch(NamedTuple):
    """Where a patch is sampled around its keypoint."""

    offsets: Float[Array, "q 2"]
    """(x, y), whole pixels of the reference view."""
    weights: Float[Array, " q"]
    """Sum 1."""


class Templates(NamedTuple):
    """Reference patches."""

    values: Float[Array, "n q c"]
    """Weighted mean 0 in every channel, weighted variance 1 over all channels; 0 where flat."""
    descent: Float[Array, "n q c 2"]
    """Derivative of `values` with respect to the shift of the patch, per reference pixel. What a
    change of gain or offset would explain has been taken out."""
    hessian: Float[Array, "n 2 2"]
    """Mean product of the derivatives."""
    covariance: Float[Array, "n 2 2"]
    """Covariance of the shift, if the values of the patch have independent noise of variance 1."""
    rest: Float[Array, "n 2"]
    """From the pixel that the patch was sampled around to the keypoint, pixels of the reference
    view."""
    contrast: Float[Array, " n"]
    """Weighted standard deviation before normalisation, units of the map."""
    inside: Bool[Array, " n"]
    """The whole patch lies in the image."""


class Aligned(NamedTuple):
    """Where keypoints ended, and how far their places can be trusted."""

    xy: Float[Array, "n 2"]
    score: Float[Array, " n"]
    """Zero-mean normalised cross-correlation at the end, -1 .. 1."""
    sigma: Float[Array, " n"]
    """Standard deviation of the position along its worst direction, pixels of the other view, if
    the patches differ by independent noise of their pixels, of which both have the same share."""
    converged: Bool[Array, " n"]
    """The last step was short, and the patch lies inside the image and is not flat."""


FLAT = 1e-5
"""A patch is flat if its deviation over its root mean square is below this."""
MAX_STEP = 1.0
"""Longest step, reference pixels."""
TOLERANCE = 0.02
"""An alignment has converged if its last step is shorter, reference pixels."""
CUBIC_STEPS = 4
"""The last steps, which interpolate by cubic convolution."""
LEAST_DETERMINANT = 0.1
"""A system is not corrected if its determinant would be smaller than this share of the hessian's:
the next step would be long, and lead anywhere."""
LEAST_HESSIAN = 1e-9
"""Added to the diagonal of a hessian, so that the deviation of a flat patch is large but finite."""


def square_patch(radius: int) -> Patch:
    """A grid of (2 radius + 1)^2 pixels, with Gaussian weights of half the radius as deviation."""
    if radius < 1:
        raise ValueError(f"radius must be at least 1; got {radius}")
    steps = jnp.arange(-radius, radius + 1, dtype=jnp.float32)
    y, x = jnp.meshgrid(steps, steps, indexing="ij")
    offsets = jnp.stack([x.ravel(), y.ravel()], axis=-1)
    weights = jnp.exp(-0.5 * jnp.sum(offsets**2, -1) / (0.5 * radius) ** 2)
    return Patch(offsets, weights / weights.sum())


def _normalise(
    values: Float[Array, "q c"], weights: Float[Array, " q"]
) -> tuple[Float[Array, "q c"], Float[Array, ""], Float[Array, ""]]:
    """Values with weighted mean 0 per channel and joint variance 1; their deviation before, and its
    inverse.

    Flat patches, whose deviation is no more than the rounding of float32 values, become zero.
    """
    power = jnp.einsum("q,qc->", weights, values * values, precision=HIGHEST)
    values = values - jnp.einsum("q,qc->c", weights, values, precision=HIGHEST)
    variance = jnp.einsum("q,qc->", weights, values * values, precision=HIGHEST)
    flat = variance <= FLAT**2 * power
    safe = jnp.where(flat, 1.0, variance)
    scale = jnp.where(flat, 0.0, lax.rsqrt(safe))
    return values * scale, jnp.where(flat, 0.0, jnp.sqrt(safe)), scale


@jax.jit
def make_templates(
    image: Float[Array, "h w c"],
    size: Int[Array, " 2"],
    xy: Float[Array, "n 2"],
    patch: Patch,
) -> Templates:
    """Templates around keypoints of a reference view.

    A patch is sampled around the pixel nearest to its keypoint, and `align` adds the rest of the
    way. Between pixels, the noise of an interpolated value is correlated with that of its gradient.
    With noise of an eighth of the contrast this moved keypoints by as much as the noise itself.
    """
    last = size[::-1] - 1

    def one(centre):
        nearest = jnp.round(centre)
        at = nearest.astype(jnp.int32) + patch.offsets.astype(jnp.int32)
        inside = ((at >= 0) & (at <= last)).all()
        values = pixels(image, size, at, centre.dtype)
        g = slopes(image, size, at, centre.dtype)
        values, contrast, scale = _normalise(values, patch.weights)
        g = g * scale
        # Gain and offset are projected out of the gradient. A shift that looks like a change of
        # contrast must not count as information.
        g = g - jnp.einsum("q,qck->ck", patch.weights, g, precision=HIGHEST)
        along = jnp.einsum("q,qc,qck->k", patch.weights, values, g, precision=HIGHEST)
        g = g - values[..., None] * along
        hessian = jnp.einsum("q,qck,qcl->kl", patch.weights, g, g, precision=HIGHEST)
        noisy = jnp.einsum("q,qck,qcl->kl", patch.weights**2, g, g, precision=HIGHEST)
        covariance = _shift_covariance(hessian, noisy, jnp.sum(patch.weights**2))
        rest = centre - nearest
        return Templates(values, g, hessian, covariance, rest, contrast, inside)

    return jax.vmap(one)(xy)


def _determinant(a: Float[Array, "2 2"]) -> Float[Array, ""]:
    return a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]


def _solve2(a: Float[Array, "2 2"], b: Float[Array, " 2"]) -> Float[Array, " 2"]:
    det = _determinant(a)
    ok = det > 1e-12
    inv = jnp.where(ok, 1.0 / jnp.where(ok, det, 1.0), 0.0)
    return inv * jnp.stack([a[1, 1] * b[0] - a[0, 1] * b[1], a[0, 0] * b[1] - a[1, 0] * b[0]])


def _shift_covariance(
    hessian: Float[Array, "2 2"], noisy: Float[Array, "2 2"], squares: Float[Array, ""]
) -> Float[Array, "2 2"]:
    """H^-1 N H^-1, the covariance of a weighted least-squares shift.

    Args:
      hessian: H = sum w g g^T, with weights w and derivatives g.
      noisy: N = sum w^2 g g^T.
      squares: sum w^2.
    """
    least = LEAST_HESSIAN * jnp.eye(2, dtype=hessian.dtype)
    h, noisy = hessian + least, noisy + squares * least
    # The determinant of a straight edge is smaller than its rounding.
    smallest = LEAST_HESSIAN * (h[0, 0] + h[1, 1])
    det = jnp.maximum(_determinant(h), smallest)
    inverse = jnp.stack([h[1, 1], -h[0, 1], -h[1, 0], h[0, 0]]).reshape(2, 2) / det
    return jnp.einsum("ij,jk,kl->il", inverse, noisy, inverse, precision=HIGHEST)


def _largest_eigenvalue(s: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Of a symmetric matrix."""
    mean, diff = 0.5 * (s[0, 0] + s[1, 1]), 0.5 * (s[0, 0] - s[1, 1])
    return mean + jnp.sqrt(diff**2 + s[0, 1] ** 2 + 1e-30)


class _Search(NamedTuple):
    """Where a search is after some steps."""

    at: Float[Array, " 2"]
    """Pixels of the other view."""
    system: Float[Array, "2 2"]
    """How the misfit changes with a shift."""
    misfit: Float[Array, " 2"]
    """Before the last step: what the derivatives of the template explain of the difference."""
    shift: Float[Array, " 2"]
    """The last step, reference pixels. Zero: there was none, or its misfit was another one."""


def _corrected(
    last: _Search, misfit: Float[Array, " 2"], hessian: Float[Array, "2 2"]
) -> Float[Array, "2 2"]:
    """The system that explains the last change of the misfit, and else is the one before.

    It stays as it is if it would become nearly singular.
    """
    unexplained = misfit - last.misfit - jnp.matmul(last.system, last.shift, precision=HIGHEST)
    moved = jnp.maximum(jnp.sum(last.shift**2), 1e-10)
    made = last.system + jnp.outer(unexplained, last.shift) / moved
    positive = (made[0, 0] + made[1, 1] > 0) & (
        _determinant(made) > LEAST_DETERMINANT * _determinant(hessian)
    )
    return jnp.where(positive, made, last.system)


@functools.partial(jax.jit, static_argnames=("iterations",))
def align(
    image: Float[Array, "h w c"],
    size: Int[Array, " 2"],
    templates: Templates,
    xy: Float[Array, "n 2"],
    affine: Float[Array, "n 2 2"],
    patch: Patch,
    *,
    iterations: int = 8,
) -> Aligned:
    """Move keypoints of a view onto their templates.

    Args:
      image: the view's map.
      size: valid (rows, columns) of the map.
      templates: patches of the same tracks in their reference views.
      xy: where to start, pixels of the view.
      affine: maps reference offsets to offsets in the view (from the local plane).
      patch: the patch that the templates were made with.
      iterations: number of steps. The last `CUBIC_STEPS` of them interpolate by cubic convolution.
    """

    def one(t: Templates, start, a):
        offsets = jnp.einsum("qk,lk->ql", patch.offsets, a, precision=HIGHEST)

        def step(last: _Search, values) -> tuple[_Search, Float[Array, ""]]:
            r = _normalise(values, patch.weights)[0] - t.values
            misfit = jnp.einsum("q,qc,qck->k", patch.weights, r, t.descent, precision=HIGHEST)
            system = _corrected(last, misfit, t.hessian)
            d = -_solve2(system, misfit)
            length = jnp.sqrt(jnp.sum(d * d) + 1e-20)
            d = d * jnp.minimum(1.0, MAX_STEP / length)
            return _Search(last.at + jnp.matmul(a, d, precision=HIGHEST), system, misfit, d), length

        def near(last: _Search, _):
            return step(last, sample_linear(image, size, last.at + offsets))

        def exact(last: _Search, _):
            return step(last, sample(image, size, last.at + offsets)[0])

        rest = jnp.matmul(a, t.rest, precision=HIGHEST)
        none = jnp.zeros_like(start)
        linear = max(iterations - CUBIC_STEPS, 0)
        first = _Search(start - rest, t.hessian, none, none)
        brought, _ = lax.scan(near, first, None, length=linear)
        # Other values between pixels are another misfit, so the last step explains no change of it.
        brought = brought._replace(shift=none)
        (at, *_), lengths = lax.scan(exact, brought, None, length=iterations - linear)
        values, inside = sample(image, size, at + offsets)
        values, contrast, _ = _normalise(values, patch.weights)
        score = jnp.einsum("q,qc,qc->", patch.weights, values, t.values, precision=HIGHEST)
        # The mean square difference of two patches of variance 1 is 2 (1 - score). Interpolation
        # has reduced the noise in it, and divided by the share that is kept it is the noise of a
        # pixel. A keypoint is moved by the part of the noise that is as smooth as the derivatives.
        # Interpolation does not reduce this part, and samples that share pixels have it in common.
        # The template was sampled at whole pixels, each of which keeps its noise.
        kept, area = noise_kept(at + offsets, patch.weights), jnp.abs(_determinant(a))
        pixel = 2 * jnp.maximum(1 - score, 1e-6) / (values.shape[-1] * (1 + kept))
        summed = 1 + noise_summed(area, kept)
        covariance = jnp.einsum("ij,jk,lk->il", a, t.covariance, a, precision=HIGHEST)
        sigma = jnp.sqrt(pixel * summed * _largest_eigenvalue(covariance))
        converged = (lengths[-1] < TOLERANCE) & (contrast > 0) & (t.contrast > 0)
        return Aligned(at + rest, score, sigma, converged & inside.all() & t.inside)

    return jax.vmap(one)(templates, xy, affine)
