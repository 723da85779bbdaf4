"""COLMAP's camera models as one function: a ray of a camera becomes a place on the photo.

All models have ten numbers in common: fx, fy, cx, cy, k1 to k4, p1 and p2. A model that lacks a
number has zero there, and a model with one focal length uses it twice. So a scene may have cameras
of several models, and there is one program for all.

Source: COLMAP's sensor/models.h. Its undistorted pinhole and OpenCV's models are special cases.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsfm.core.numerics import HIGHEST

MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}
"""The parameters of each model, in COLMAP's order."""
WIDTH = 8
"""The most parameters that a model has."""
_NUMBERS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
_FISHEYE = np.asarray([name.endswith("FISHEYE") for name in MODELS])
_SPREAD = np.zeros((len(MODELS), len(_NUMBERS), WIDTH), np.float32)
"""By model: the matrix that makes the ten numbers of its parameters."""
for _model, _names in enumerate(MODELS.values()):
    for _place, _name in enumerate(_names.split()):
        for _number in ("fx", "fy") if _name == "f" else (_name,):
            _SPREAD[_model, _NUMBERS.index(_number), _place] = 1


def intrinsics_of(
    models: Sequence[str], params: Sequence[Sequence[float]]
) -> tuple[Float[np.ndarray, "k 8"], Int[np.ndarray, " k"]]:
    """COLMAP's parameters of cameras with zeros after them, float64, and the places of their models
    in `MODELS`, int32.

    Lengths are pixels. Whether (0, 0) is the centre or the corner of the first pixel is the choice
    of the caller; in COLMAP it is the corner.

    Raises:
      ValueError: a model is not in `MODELS`, or has another number of parameters.
    """
    wide = np.zeros((len(models), WIDTH))
    for row, name, given in zip(wide, models, params, strict=True):
        if name not in MODELS:
            raise ValueError(f"a camera model is one of {', '.join(MODELS)}, not {name!r}")
        if len(given) != (count := len(MODELS[name].split())):
            raise ValueError(f"{name} has {count} parameters, but was given {len(given)}")
        row[: len(given)] = given
    return wide, np.asarray([list(MODELS).index(name) for name in models], np.int32)


def spread(model: Int[Array, " *n"], dtype) -> Float[Array, "*n 10 8"]:
    """The matrices that make the ten numbers of a model's parameters."""
    return jnp.asarray(_SPREAD, dtype)[model]


def numbers_of(
    params: Float[Array, "k 8"], model: Int[Array, " k"]
) -> tuple[Float[Array, "k 10"], Float[Array, " k"]]:
    """The ten numbers of cameras, and 1 for fisheyes, else 0."""
    matrices = spread(model, params.dtype)
    numbers = jnp.einsum("kij,kj->ki", matrices, params, precision=HIGHEST)
    return numbers, jnp.asarray(_FISHEYE, params.dtype)[model]


def projected(
    numbers: Float[Array, "10 ..."], fisheye: Float[Array, "..."], rays: Float[Array, "3 ..."]
) -> Float[Array, "2 ..."]:
    """Places on the photo, pixels. Coordinates are the first axis, so that their arrays are long.

    A fisheye sees rays at any angle from its axis. Other cameras project what lies behind them
    through their centre.
    """
    fx, fy, cx, cy, k1, k2, k3, k4, p1, p2 = numbers
    x, y, z = rays
    scale = _scale(fisheye, x * x + y * y, z)
    u, v = x * scale, y * scale
    uu, uv, vv = u * u, u * v, v * v
    s = uu + vv
    radial = 1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
    out = u * radial + 2 * p1 * uv + p2 * (s + 2 * uu)
    down = v * radial + 2 * p2 * uv + p1 * (s + 2 * vv)
    return jnp.stack([fx * out + cx, fy * down + cy])


def _scale(fisheye: Array, square: Array, z: Array) -> Array:
    """1 / z, or for fisheyes the angle from the axis by the distance from it, which is given
    squared."""
    # Near the axis this is a series, because the quotient has no derivatives there. The next term
    # is below the rounding of float64, and so are its derivatives.
    near = (square < 1e-8 * z * z) & (z > 0)
    one = jnp.ones_like(z)
    distance, along = jnp.sqrt(jnp.where(near, one, square)), jnp.where(near, z, one)
    q = square / along**2
    series = (1 - q * (1 / 3 - q / 5)) / along
    angle = jnp.where(near, series, jnp.arctan2(distance, z) / distance)
    return jnp.where(fisheye > 0, angle, 1 / z)


def slopes(
    numbers: Float[Array, "10 n"],
    fisheye: Float[Array, " n"],
    rays: Float[Array, "3 n"],
    ways: Float[Array, "m 10 n"],
) -> Float[Array, "_ 2 n"]:
    """The derivatives of `projected` along m ways of the ten numbers, and then in the ray.

    They are in closed form: a forward derivative for each makes twice as large a program.
    """
    fx, fy, _, _, k1, k2, k3, k4, p1, p2 = numbers
    x, y, z = rays
    square, one, zero = x * x + y * y, jnp.ones_like(z), jnp.zeros_like(z)
    scale, by_square = jax.jvp(lambda q: _scale(fisheye, q, z), (square,), (one,))
    _, by_z = jax.jvp(lambda q: _scale(fisheye, square, q), (z,), (one,))
    u, v = x * scale, y * scale
    uu, uv, vv = u * u, u * v, v * v
    s = uu + vv
    radial = 1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
    twice = 2 * (k1 + s * (2 * k2 + s * (3 * k3 + s * 4 * k4)))
    out = u * radial + 2 * p1 * uv + p2 * (s + 2 * uu)
    down = v * radial + 2 * p2 * uv + p1 * (s + 2 * vv)
    powers = [s, s * s, s * s * s, s * s * s * s]
    by_numbers = (
        [[out, zero], [zero, down], [one, zero], [zero, one]]
        + [[fx * u * power, fy * v * power] for power in powers]
        + [[2 * fx * uv, fy * (s + 2 * vv)], [fx * (s + 2 * uu), 2 * fy * uv]]
    )
    own = (ways[:, :, None] * jnp.stack([jnp.stack(pair) for pair in by_numbers])).sum(1)
    mixed = uv * twice + 2 * (p1 * u + p2 * v)
    by_u = jnp.stack([fx * (radial + uu * twice + 2 * p1 * v + 6 * p2 * u), fy * mixed])
    by_v = jnp.stack([fx * mixed, fy * (radial + vv * twice + 2 * p2 * u + 6 * p1 * v)])
    ray = [(scale + 2 * x * x * by_square, 2 * x * y * by_square)]
    ray += [(2 * x * y * by_square, scale + 2 * y * y * by_square), (x * by_z, y * by_z)]
    return jnp.concatenate([own, jnp.stack([a * by_u + b * by_v for a, b in ray])])


def directions(
    numbers: Float[Array, "10 n"], fisheye: Float[Array, " n"], xy: Float[Array, "2 n"]
) -> Float[Array, "2 n"]:
    """x / z and y / z of the rays that are projected to places on the photo: ten steps of Newton.

    Source: COLMAP's IterativeUndistortion. Rays at 90 degrees and more have no such coordinates.
    """
    guess = (xy - numbers[2:4]) / numbers[:2]

    def nearer(_, uv):
        rays = jnp.stack([*uv, jnp.ones_like(uv[0])])
        (a, c), (b, d), _ = slopes(numbers, fisheye, rays, jnp.zeros_like(numbers[None])[:0])
        left, up = xy - projected(numbers, fisheye, rays)
        determinant = a * d - b * c
        return uv + jnp.stack([d * left - b * up, a * up - c * left]) / determinant

    return lax.fori_loop(0, 10, nearer, guess)
