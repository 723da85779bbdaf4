"""Laws of a step of a bundle adjustment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from strategies import rng_of

from jaxsfm.core.bundle_layout import Free, Layout, layout_of
from jaxsfm.core.bundle_problem import Poses, Scene
from jaxsfm.core.bundle_step import moved

PHOTOS, POINTS = 7, 30


def scene(seed: int) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Photos and points anywhere, and the photo and the point of each row: neighbours in a row of
    photos have common points, and the last photo has none."""
    rng = rng_of(seed)
    poses = Poses(Rotation.random(PHOTOS, rng=rng).as_matrix(), rng.normal(size=(PHOTOS, 3)))
    points = rng.normal(size=(POINTS, 4))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    point = np.repeat(np.arange(POINTS), 2)
    photo = (np.arange(POINTS)[:, None] % (PHOTOS - 2) + [0, 1]).ravel()
    return jax.tree.map(jnp.asarray, Scene(poses, points, np.ones((1, 8)))), photo, point


def layout(photo: np.ndarray, point: np.ndarray, held: int | None = None) -> Layout:
    free = Free(np.ones((PHOTOS, 6), bool), np.arange(POINTS) != held, np.zeros((1, 8), bool))
    if held is not None:
        free.poses[held, 3] = False
    camera, model = np.zeros(PHOTOS, int), np.zeros(1, int)
    made = layout_of(photo, point, free, camera=camera, model=model)
    return jax.tree.map(jnp.asarray, made)


def straight(start: Scene, poses: np.ndarray, by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 3, 4) and points (n, 4) to first order: each moves by itself."""
    rotations = np.asarray(start.poses.rotations)
    turn = np.cross(poses[:, None, :3], rotations, axisb=1, axisc=1)
    shift = np.concatenate([turn, poses[:, 3:, None]], axis=2)
    return shift, by


def as_matrices(found: Scene) -> np.ndarray:
    return np.concatenate([found.poses.rotations, found.poses.translations[..., None]], axis=2)


def seen(found: Scene, photo: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The directions in which photos see points."""
    rays = np.einsum("nij,nj->ni", as_matrices(found)[photo], np.asarray(found.points)[point])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.parametrize("held", [None, 3])
def test_to_first_order_everything_moves_by_itself(held):
    with jax.enable_x64(True):
        start, photo, point = scene(1)
        made, rng = layout(photo, point, held), rng_of(2)
        poses, by = rng.normal(size=(PHOTOS, 6)), rng.normal(size=(POINTS, 3))
        if held is not None:
            poses[held, 3] = by[held] = 0
        step = 1e-5

        def at(share: float) -> Scene:
            return moved(start, made, jnp.asarray(share * poses.ravel()), jnp.asarray(share * by))

        change = (as_matrices(at(step)) - as_matrices(at(-step))) / (2 * step)
        expected, _ = straight(start, poses, by)
        np.testing.assert_allclose(change, expected, atol=1e-8)
        points = (np.asarray(at(step).points) - at(-step).points) / (2 * step)
        np.testing.assert_allclose(
            np.linalg.norm(points, axis=1), np.linalg.norm(by, axis=1), rtol=1e-8
        )
        np.testing.assert_allclose((points * start.points).sum(1), 0, atol=1e-8)


@pytest.mark.parametrize("angle", [0.1, 1.5])
def test_a_turn_of_the_whole_scene_changes_what_no_photo_sees(angle):
    """However far it turns: no photo is left behind, and no point."""
    with jax.enable_x64(True):
        start, photo, point = scene(3)
        made, axis = layout(photo, point), angle * np.asarray([0.6, 0.0, 0.8])
        poses = np.zeros((PHOTOS, 6))
        poses[:, :3] = -np.asarray(start.poses.rotations) @ axis
        to = np.cross(axis, start.points[:, :3])
        wide = np.concatenate([to, np.zeros((POINTS, 1))], axis=1)
        by = jnp.stack([_columns(x) @ w for x, w in zip(start.points, wide, strict=True)])
        after = moved(start, made, jnp.asarray(poses.ravel()), by)
        np.testing.assert_allclose(seen(after, photo, point), seen(start, photo, point), atol=1e-9)
        turned = np.asarray(after.poses.rotations) - start.poses.rotations
        assert np.abs(turned).max() > 0.05


def _columns(x: np.ndarray) -> np.ndarray:
    """The directions of a point's numbers, as rows: Householder's reflection."""
    v = x + np.asarray([0, 0, 0, 1.0 if x[3] >= 0 else -1.0])
    return (np.eye(4) - 2 * np.outer(v, v) / (v @ v))[:3]


def test_what_is_held_stays_to_the_last_bit():
    with jax.enable_x64(True):
        start, photo, point = scene(5)
        free = layout(photo, point, 2).free
        made, rng = layout(photo, point)._replace(free=free), rng_of(6)  # held afterwards
        poses, by = rng.normal(size=6 * PHOTOS), rng.normal(size=(POINTS, 3))
        after = moved(start, made, jnp.asarray(poses), jnp.asarray(by))
        assert after.poses.translations[2, 0] == start.poses.translations[2, 0]
        np.testing.assert_array_equal(after.params, start.params)
        np.testing.assert_allclose(after.points[2], start.points[2], rtol=1e-15)


def test_photos_form_a_forest_of_neighbours():
    with jax.enable_x64(True):
        _, photo, point = scene(0)
    parent = layout(photo, point).parent
    assert parent[PHOTOS - 1] == PHOTOS and (parent == PHOTOS).sum() == 2
    for one in range(PHOTOS - 1):
        assert parent[one] == PHOTOS or abs(one - parent[one]) == 1
        way = one
        for _ in range(PHOTOS):  # no circle
            way = parent[way] if way < PHOTOS else way
        assert way == PHOTOS
