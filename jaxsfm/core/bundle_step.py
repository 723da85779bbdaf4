"""A step of a bundle adjustment: how a scene moves.

Poses and points of a step are those of a linear model, and a scene is not linear. A row of photos
that is bent by a small angle moves along arcs when it is unbent: a photo at its far end turns, and
goes round the other end. On straight lines it would end beside its neighbours, and far from its
points. So each photo moves relative to a neighbour, and each point relative to a photo. To first
order this is the same step.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsfm.core.bundle_layout import Layout
from jaxsfm.core.bundle_problem import Poses, Scene, turned
from jaxsfm.core.numerics import squared_norm, unit


def moved(
    scene: Scene, layout: Layout, cameras: Float[Array, " z"], points: Float[Array, "p 3"]
) -> Scene:
    """The scene after a step; what is held stays as it is."""
    poses, homogeneous, params = scene
    end, free = poses.translations.size * 2, layout.free
    by = jnp.where(free.poses, cameras[:end].reshape(-1, 6), 0.0)
    world = jnp.int32(len(by))
    parent = jnp.append(jnp.where(free.poses.all(1), layout.parent, world), world)
    before = _with_world(*poses), jnp.concatenate([by, jnp.zeros_like(by[:1])])
    after = _composed(*before, parent)
    shift = cameras[end:].reshape(len(params), -1)
    shift = jnp.where(free.params[:, layout.columns], shift, 0.0)
    params = params.at[:, layout.columns].add(shift)
    to = homogeneous + _across(homogeneous, jnp.where(free.points[:, None], points, 0.0))
    host = jnp.where(free.points, layout.host, world)
    to = _points(*before, after, host, (homogeneous, to))
    return Scene(Poses(*(x[:-1] for x in after)), to, params)


def _with_world(rotations: Float[Array, "c 3 3"], translations: Float[Array, "c 3"]) -> Poses:
    """One more pose, which is the world's."""
    eye, nothing = jnp.eye(3, dtype=rotations.dtype), jnp.zeros_like(translations[:1])
    return Poses(jnp.concatenate([rotations, eye[None]]), jnp.concatenate([translations, nothing]))


def _times(matrix: Float[Array, "n 3 3"], x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return (matrix * x[:, None]).sum(-1)


def _product(one: Float[Array, "n 3 3"], other: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
    return (one[..., None] * other[:, None]).sum(2)


def _composed(poses: Poses, by: Float[Array, "c 6"], parent: Int[Array, " c"]) -> Poses:
    """The poses after the step: each photo moves linearly in the frame of its parent."""
    rotations, translations = poses
    relative = _product(rotations, rotations[parent].mT)
    reach = _times(relative, translations[parent])
    turn = by[:, :3] - _times(relative, by[parent, :3])
    shift = by[:, 3:] - _times(relative, by[parent, 3:]) - jnp.cross(turn, reach)
    found = Poses(turned(turn[:, None], relative.mT).mT, translations - reach + shift)
    for _ in range(len(parent).bit_length()):  # products of 1, 2, 4, ... photos of each way
        before = Poses(*(x[parent] for x in found))
        found = Poses(
            _product(found.rotations, before.rotations),
            _times(found.rotations, before.translations) + found.translations,
        )
        parent = parent[parent]
    # Products of many rotations drift away from rotations; this brings them back.
    square = _product(found.rotations, found.rotations.mT)
    return found._replace(rotations=1.5 * found.rotations - 0.5 * _product(square, found.rotations))


def _across(x: Float[Array, "p 4"], by: Float[Array, "p 3"]) -> Float[Array, "p 4"]:
    """`across` of each point times its numbers."""
    v = x.at[:, 3].add(jnp.where(x[:, 3] >= 0, 1.0, -1.0).astype(x.dtype))
    share = 2 * (v[:, :3] * by).sum(1) / squared_norm(v)
    return jnp.concatenate([by, jnp.zeros_like(by[:, :1])], axis=1) - share[:, None] * v


def _points(
    poses: Poses,
    by: Float[Array, "c 6"],
    after: Poses,
    host: Int[Array, " p"],
    straight: tuple[Float[Array, "p 4"], Float[Array, "p 4"]],
) -> Float[Array, "p 4"]:
    """Points of length 1 that moved as their photos see it.

    Args:
      straight: the points, and where each would move by itself.
    """
    (rotations, translations), there = (Poses(*(x[host] for x in each)) for each in (poses, after))
    step, (x, to) = by[host], straight
    seen = _times(rotations, to[:, :3]) + translations * to[:, 3:]
    seen += jnp.cross(step[:, :3], _times(rotations, x[:, :3])) + step[:, 3:] * x[:, 3:]
    place = _times(there.rotations.mT, seen - there.translations * to[:, 3:])
    return unit(jnp.concatenate([place, to[:, 3:]], axis=1))
