"""Homographies: four-point solution, least squares, transfer test.

h maps image 0 to image 1: (x1, y1, 1) ~ h (x0, y0, 1). All computations are in float32, on
coordinates that were centred and scaled (`normalisation`). In raw pixel coordinates the normal
equations would lose all digits of float32.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsfm.core.numerics import HIGHEST

MIN_AREA = 1e-4
"""Three points are collinear if twice the area of their triangle, in normalised units squared, is
below this."""


def homogeneous(xy: Float[Array, "*n 2"]) -> Float[Array, "*n 3"]:
    """Homogeneous coordinates (x, y, 1) of points."""
    return jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)


def normalisation(xy: Float[Array, "k 2"], weight: Float[Array, " k"]) -> Float[Array, "3 3"]:
    """The similarity that moves weighted points to mean 0 and root mean square radius sqrt(2).

    Both axes have one scale, so that a circle stays a circle.
    Source: Hartley 1997, section 5.
    """
    x, y = xy[:, 0], xy[:, 1]  # columns: sums over (k, 2) are read with a stride of two
    total = jnp.maximum(weight.sum(), 1.0)
    mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
    spread = (weight * ((x - mean_x) ** 2 + (y - mean_y) ** 2)).sum() / total
    scale = jnp.sqrt(2.0 / jnp.where(spread > 0, spread, 2.0))
    diagonal = jnp.asarray([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 0]], scale.dtype) * scale
    last = jnp.stack([-scale * mean_x, -scale * mean_y, jnp.ones_like(scale)])
    return diagonal + jnp.zeros((3, 3), scale.dtype).at[:, 2].set(last)


def apply_affine(t: Float[Array, "3 3"], xy: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """Points mapped by a similarity or an affinity. There is no matrix product, so the result is
    precise on every backend."""
    return jnp.stack(
        [
            t[0, 0] * xy[..., 0] + t[0, 1] * xy[..., 1] + t[0, 2],
            t[1, 0] * xy[..., 0] + t[1, 1] * xy[..., 1] + t[1, 2],
        ],
        axis=-1,
    )


def adjugate(m: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """adj(m) with adj(m) m = det(m) I: the inverse up to scale, which exists for singular m too."""
    a, b, c = m[..., :, 0], m[..., :, 1], m[..., :, 2]
    return jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-2)


def _basis(xy: Float[Array, "*b 4 2"]) -> tuple[Array, Array, Array]:
    """The first three points as columns, the adjugate of that matrix, and the coordinates of the
    fourth point in it.

    The coordinates are twice the signed areas of the triangles that the fourth point forms with two
    of the others.
    """
    points = homogeneous(xy)
    columns = jnp.swapaxes(points[..., :3, :], -1, -2)
    adj = adjugate(columns)
    return columns, adj, jnp.sum(adj * points[..., 3, None, :], axis=-1)


def from_four_points(
    xy0: Float[Array, "*b 4 2"], xy1: Float[Array, "*b 4 2"]
) -> tuple[Float[Array, "*b 3 3"], Bool[Array, "*b"]]:
    """The homography through four correspondences, and whether they determine one.

    This is a closed form by projective bases, because linear solvers take batches of 8 x 8 systems
    one by one on CPUs. Let A, B have the first three points of the images as columns, and let l, m
    be the coordinates of the fourth points in them. Then h = B diag(m / l) adj(A).

    Four correspondences are not valid if three points are collinear, or if a triangle is mirrored
    between the images, which no camera can do.

    Source: Hartley and Zisserman, 2nd ed., section 2.3 and table 22.1 (chirality).
    """
    _, adj0, area0 = _basis(xy0)
    columns1, adj1, area1 = _basis(xy1)
    # The signed areas of all four triangles: three with the fourth point, and the first three.
    whole0 = area0.sum(-1, keepdims=True)
    whole1 = area1.sum(-1, keepdims=True)
    all0 = jnp.concatenate([area0, whole0], axis=-1)
    all1 = jnp.concatenate([area1, whole1], axis=-1)
    valid = jnp.all((jnp.abs(all0) > MIN_AREA) & (jnp.abs(all1) > MIN_AREA), axis=-1)
    valid &= jnp.all(all0 * all1 > 0, axis=-1)
    ratio = area1 / jnp.where(area0 == 0, 1.0, area0)
    h = jnp.sum((columns1 * ratio[..., None, :])[..., :, :, None] * adj0[..., None, :, :], axis=-2)
    return orient(h), valid


def orient(h: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """h with Frobenius norm 1 and positive determinant, so that w > 0 in front of both cameras."""
    det = jnp.sum(h[..., 0] * jnp.cross(h[..., 1], h[..., 2]), axis=-1)
    norm = jnp.sqrt(jnp.maximum(jnp.sum(h * h, axis=(-1, -2)), 1e-30))
    return h * (jnp.where(det < 0, -1.0, 1.0) / norm)[..., None, None]


def least_squares(
    xy0: Float[Array, "k 2"], xy1: Float[Array, "k 2"], weight: Float[Array, " k"]
) -> Float[Array, "3 3"]:
    """Weighted direct linear transform: the last eigenvector of the 9 x 9 normal matrix.

    It belongs to the smallest eigenvalue. Points of weight zero do not count. Coordinates are
    normalised inside.

    Source: Hartley and Zisserman, 2nd ed., algorithm 4.2.
    """
    t0, t1 = normalisation(xy0, weight), normalisation(xy1, weight)
    p, q = apply_affine(t0, xy0), apply_affine(t1, xy1)
    x, y, u, v = p[:, 0], p[:, 1], q[:, 0], q[:, 1]
    one = jnp.ones_like(x)
    # The normal matrix of the rows (p, 0, -u p) and (0, p, -v p) has blocks that are sums of p p'
    # times 1, -u, -v and u^2 + v^2.
    squares = jnp.stack([x * x, x * y, y * y, x, y, one])
    factors = weight * jnp.stack([one, -u, -v, u * u + v * v])
    sums = jnp.einsum("fk,sk->fs", factors, squares, precision=HIGHEST)
    s, su, sv, suv = sums[:, jnp.asarray([[0, 1, 3], [1, 2, 4], [3, 4, 5]], jnp.int32)]
    zero = jnp.zeros_like(s)
    normal = jnp.block([[s, zero, su], [zero, s, sv], [su, sv, suv]])
    _, vectors = jnp.linalg.eigh(normal)
    h = vectors[:, 0].reshape(3, 3)
    return orient(compose(adjugate(t1), compose(h, t0)))


def compose(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The product a b at full float32 precision."""
    return jnp.matmul(a, b, precision=HIGHEST)


def _image_of(h: Float[Array, "*b 3 3"], xy0: Float[Array, "k 2"]) -> list[Array]:
    """The three coordinates (*b, k) of h (x, y, 1). They are computed elementwise, which is precise
    on every backend."""
    m, x, y = h[..., None], xy0[:, 0], xy0[:, 1]
    return [m[..., i, 0, :] * x + m[..., i, 1, :] * y + m[..., i, 2, :] for i in range(3)]


def transfer_inliers(
    h: Float[Array, "*b 3 3"],
    xy0: Float[Array, "k 2"],
    xy1: Float[Array, "k 2"],
    threshold: Float[Array, ""],
) -> Bool[Array, "*b k"]:
    """Whether |xy1 - h xy0| < threshold and the point lies in front of the camera (w > 0).

    The distance is measured in image 1. Both sides are multiplied by w, which avoids a division.
    """
    u, v, w = _image_of(h, xy0)
    du, dv = u - w * xy1[:, 0], v - w * xy1[:, 1]
    reach = threshold * w
    return (du * du + dv * dv < reach * reach) & (w > 0)


def transfer_error(
    h: Float[Array, "*b 3 3"], xy0: Float[Array, "k 2"], xy1: Float[Array, "k 2"]
) -> Float[Array, "*b k"]:
    """The squared error |xy1 - h xy0|^2 in image 1; infinite for points behind the camera."""
    u, v, w = _image_of(h, xy0)
    safe = jnp.where(w > 0, w, 1.0)
    square = (u / safe - xy1[:, 0]) ** 2 + (v / safe - xy1[:, 1]) ** 2
    return jnp.where(w > 0, square, jnp.inf)


def inliers(
    h: Float[Array, "*b 3 3"],
    xy0: Float[Array, "k 2"],
    xy1: Float[Array, "k 2"],
    threshold0: Float[Array, ""],
    threshold1: Float[Array, ""],
    *,
    two_way: bool,
) -> Bool[Array, "*b k"]:
    """Inliers in image 1; with `two_way` they must be inliers in image 0 as well."""
    forward = transfer_inliers(h, xy0, xy1, threshold1)
    if not two_way:
        return forward
    return forward & transfer_inliers(orient(adjugate(h)), xy1, xy0, threshold0)
