"""Sub-pixel alignment of keypoints.

A patch of the reference view is warped by the local plane and moved over another view by
Gauss-Newton steps until the two agree up to gain and offset.

Maps are (h, w, c), with c = 1 for intensities and more channels for dense features. They may be
padded at the bottom and on the right beyond `size`. A patch is a list of offsets around a keypoint
with a weight each. All functions are batched by vmap, can be compiled, and are differentiable with
respect to keypoints and maps: the number of iterations is static, and failures are masked.

The gradient of the template is used, so an iteration is one sampling of the map and the solution of
a 2 x 2 system.

Source: Baker and Matthews, IJCV 2004, section 3.2 (inverse compositional alignment).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.interpolate import noise_kept, noise_summed, sample
from jaxsfm.core.numerics import HIGHEST


class Patch(NamedTuple):
    """Where a patch is sampled around its keypoint."""

    offsets: Float[Array, "q 2"]
    """(x, y), pixels of the reference view."""
    weights: Float[Array, " q"]
    """Sum 1."""
    area: Float[Array, ""]
    """Area that a sample stands for, square pixels of the reference view."""


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
"""Longest step of one iteration, reference pixels."""
TOLERANCE = 0.02
"""An alignment has converged if its last step is shorter, reference pixels."""
LEAST_HESSIAN = 1e-9
"""Added to the diagonal of a hessian, so that the deviation of a flat patch is large but finite."""


def square_patch(radius: int, *, spacing: float = 1.0, sigma: float | None = None) -> Patch:
    """A (2 radius + 1)^2 grid with Gaussian weights (sigma in grid steps, default 0.5 radius)."""
    if radius < 1:
        raise ValueError(f"radius must be at least 1; got {radius}")
    steps = jnp.arange(-radius, radius + 1, dtype=jnp.float32)
    y, x = jnp.meshgrid(steps, steps, indexing="ij")
    offsets = jnp.stack([x.ravel(), y.ravel()], axis=-1)
    weights = jnp.exp(-0.5 * jnp.sum(offsets**2, -1) / (sigma or 0.5 * radius) ** 2)
    return Patch(offsets * spacing, weights / weights.sum(), jnp.float32(spacing**2))


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
    dx, dy = 0.5 * jnp.eye(2, dtype=xy.dtype)

    def one(centre):
        nearest = jnp.round(centre)
        at = nearest + patch.offsets
        values, inside = sample(image, size, at)
        gx = sample(image, size, at + dx)[0] - sample(image, size, at - dx)[0]
        gy = sample(image, size, at + dy)[0] - sample(image, size, at - dy)[0]
        values, contrast, scale = _normalise(values, patch.weights)
        g = jnp.stack([gx, gy], -1) * scale
        # Gain and offset are projected out of the gradient. A shift that looks like a change of
        # contrast must not count as information.
        g = g - jnp.einsum("q,qck->ck", patch.weights, g, precision=HIGHEST)
        along = jnp.einsum("q,qc,qck->k", patch.weights, values, g, precision=HIGHEST)
        g = g - values[..., None] * along
        hessian = jnp.einsum("q,qck,qcl->kl", patch.weights, g, g, precision=HIGHEST)
        noisy = jnp.einsum("q,qck,qcl->kl", patch.weights**2, g, g, precision=HIGHEST)
        covariance = _shift_covariance(hessian, noisy, jnp.sum(patch.weights**2))
        rest = centre - nearest
        return Templates(values, g, hessian, covariance, rest, contrast, inside.all())

    return jax.vmap(one)(xy)


def _solve2(a: Float[Array, "2 2"], b: Float[Array, " 2"]) -> Float[Array, " 2"]:
    det = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
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
    det = jnp.maximum(h[0, 0] * h[1, 1] - h[0, 1] * h[1, 0], smallest)
    inverse = jnp.stack([h[1, 1], -h[0, 1], -h[1, 0], h[0, 0]]).reshape(2, 2) / det
    return jnp.einsum("ij,jk,kl->il", inverse, noisy, inverse, precision=HIGHEST)


def _largest_eigenvalue(s: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Of a symmetric matrix."""
    mean, diff = 0.5 * (s[0, 0] + s[1, 1]), 0.5 * (s[0, 0] - s[1, 1])
    return mean + jnp.sqrt(diff**2 + s[0, 1] ** 2 + 1e-30)


@functools.partial(jax.jit, static_argnames=("iterations",))
def align(
    image: Float[Array, "h w c"],
    size: Int[Array, " 2"],
    templates: Templates,
    xy: Float[Array, "n 2"],
    affine: Float[Array, "n 2 2"],
    patch: Patch,
    *,
    iterations: int = 10,
) -> Aligned:
    """Move keypoints of a view onto their templates.

    Args:
      image: the view's map.
      size: valid (rows, columns) of the map.
      templates: patches of the same tracks in their reference views.
      xy: where to start, pixels of the view.
      affine: maps reference offsets to offsets in the view (from the local plane).
      patch: the patch that the templates were made with.
      iterations: number of Gauss-Newton steps.
    """

    def one(t: Templates, start, a):
        offsets = jnp.einsum("qk,lk->ql", patch.offsets, a, precision=HIGHEST)

        def residual(at):
            values, inside = sample(image, size, at + offsets)
            values, contrast, _ = _normalise(values, patch.weights)
            return values - t.values, inside.all(), contrast, values

        def step(at, _):
            r, _, _, _ = residual(at)
            b = jnp.einsum("q,qc,qck->k", patch.weights, r, t.descent, precision=HIGHEST)
            d = -_solve2(t.hessian, b)
            length = jnp.sqrt(jnp.sum(d * d) + 1e-20)
            d = d * jnp.minimum(1.0, MAX_STEP / length)
            return at + jnp.matmul(a, d, precision=HIGHEST), length

        rest = jnp.matmul(a, t.rest, precision=HIGHEST)
        at, lengths = lax.scan(step, start - rest, None, length=iterations)
        _, inside, contrast, values = residual(at)
        score = jnp.einsum("q,qc,qc->", patch.weights, values, t.values, precision=HIGHEST)
        # The mean square difference of two patches of variance 1 is 2 (1 - score). Interpolation
        # has reduced the noise in it, and divided by the share that is kept it is the noise of a
        # pixel. A keypoint is moved by the part of the noise that is as smooth as the derivatives.
        # Interpolation does not reduce this part, and samples that share pixels have it in common.
        kept = noise_kept(patch.offsets, patch.weights), noise_kept(at + offsets, patch.weights)
        areas = patch.area, patch.area * jnp.abs(a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])
        pixel = 2 * jnp.maximum(1 - score, 1e-6) / (values.shape[-1] * (kept[0] + kept[1]))
        summed = noise_summed(areas[0], kept[0]) + noise_summed(areas[1], kept[1])
        covariance = jnp.einsum("ij,jk,lk->il", a, t.covariance, a, precision=HIGHEST)
        sigma = jnp.sqrt(pixel * summed * _largest_eigenvalue(covariance))
        ok = inside & t.inside & (lengths[-1] < TOLERANCE) & (contrast > 0) & (t.contrast > 0)
        return Aligned(at + rest, score, sigma, ok)

    return jax.vmap(one)(templates, xy, affine)
