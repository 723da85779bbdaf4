"""Laws of learning from poses: the error of poses reaches a function of the pixels."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import tolerances
from test_posed_pairs import inputs  # noqa: F401 - a fixture

from jaxsfm.bench.synthetic import arc, camera_matrix
from jaxsfm.config import preset
from jaxsfm.core.bundle_problem import Poses
from jaxsfm.core.scores import WALKED, init_scores
from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.io.pairs import PairResult
from jaxsfm.matching.extraction import image_features
from jaxsfm.training import pose_problems
from jaxsfm.training.pose_problems import (
    PosedTracks,
    PoseProblem,
    draw,
    pose_error,
    pose_layout,
    posed_tracks,
    walk_in_cells,
)

PHOTOS, COUNT = 3, 24


def place(scores, maps):
    """The mean ends of random walks, all of one weight."""
    at = walk_in_cells(scores, maps, variant="soft")
    return at, jnp.ones(len(at), at.dtype)


@jax.jit
@jax.value_and_grad
def _loss(scores, problem):
    return pose_error(*place(scores, problem.maps), problem, pose_layout(PHOTOS, COUNT))[0]


def loss(scores, problem):
    with jax.enable_x64(True):
        return jax.device_get(_loss(scores, problem))


def perturbed(seed: int) -> dict:
    """Scores, float64, that are not the norm rule."""
    rng = np.random.default_rng(seed)
    start = jax.device_get(init_scores(jax.random.key(0), hidden=4))
    return jax.tree.map(lambda x: x + 0.2 * rng.normal(size=x.shape), start)


@pytest.fixture(scope="module")
def problem() -> PoseProblem:
    """Photos of a box of points that are seen exactly if `place` is given `perturbed(0)`, but for
    noise of a quarter of a pixel; random maps. Photo 1 does not see the first two tracks."""
    rng, size = np.random.default_rng(3), (640, 480)
    cameras = arc(PHOTOS)
    rotations = np.stack([pose.rotation for pose in cameras])
    shifts = np.stack([-pose.rotation @ pose.centre for pose in cameras])
    k = camera_matrix(size)
    points = rng.uniform([-1.5, -1, 4], [1.5, 1, 7], (COUNT, 3))
    seen = np.einsum("cij,pj->cpi", rotations, points) + shifts[:, None]
    xy = ((seen / seen[..., 2:]) @ k.T)[..., :2].reshape(-1, 2)
    maps = tuple(
        np.abs(rng.normal(size=(len(xy), side, side, channels)))
        for side, channels in zip((8, 4, 2), WALKED.values(), strict=True)
    )
    with jax.enable_x64(True):
        at = np.asarray(jax.jit(place)(perturbed(0), maps)[0])
    weight = np.ones((PHOTOS, COUNT))
    weight[1, :2] = 0
    corner = xy - at + 0.25 * rng.normal(size=xy.shape)
    params = np.asarray([[k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0, 0, 0, 0]])
    return PoseProblem(maps, corner, weight.ravel(), Poses(rotations, shifts), params)


@pytest.mark.slow
def test_the_gradient_of_the_pose_error_is_that_of_central_differences(problem):
    scores, rng = perturbed(1), np.random.default_rng(5)
    way = jax.tree.map(lambda x: rng.normal(size=x.shape), scores)
    ahead, here, behind = (
        loss(jax.tree.map(lambda x, w, by=by: x + by * w, scores, way), problem)
        for by in (1e-5, 0.0, -1e-5)
    )
    slope = sum(np.sum(g * w) for g, w in zip(*map(jax.tree.leaves, (here[1], way)), strict=True))
    assert abs(slope) > 1e-6
    np.testing.assert_allclose(slope, (ahead[0] - behind[0]) / 2e-5, **tolerances.EXACT_GRADIENT)


@pytest.mark.slow
def test_a_few_steps_lower_the_pose_error(problem):
    scores, optimizer = perturbed(1), optax.adam(0.02)
    with jax.enable_x64(True):
        state = optimizer.init(scores)
    errors = []
    for _ in range(8):
        error, gradient = loss(scores, problem)
        errors.append(error)
        with jax.enable_x64(True):
            update, state = optimizer.update(gradient, state)
            scores = jax.device_get(optax.apply_updates(scores, update))
    assert errors[-1] < 0.5 * errors[0]


@pytest.mark.slow
def test_cells_that_are_not_seen_change_nothing(problem):
    unseen = problem.seen == 0
    maps = tuple(np.where(unseen[:, None, None, None], np.flip(x, -1) + 1, x) for x in problem.maps)
    corner = problem.corner + 50 * unseen[:, None]
    jax.tree.map(
        np.testing.assert_array_equal,
        loss(perturbed(1), problem),
        loss(perturbed(1), problem._replace(maps=maps, corner=corner)),
    )


def tracks_of(cell: np.ndarray) -> PosedTracks:
    """Tracks whose cells are numbered."""
    rows = np.arange(cell.max() + 1, dtype=np.float32)
    maps = tuple(
        np.broadcast_to(rows[:, None, None, None], (len(rows), n, n, 1)) for n in (8, 4, 2)
    )
    names = [str(k) for k in range(len(cell))]
    poses = Poses(np.stack([np.eye(3)] * len(cell)), np.arange(3.0 * len(cell)).reshape(-1, 3))
    return PosedTracks(names, maps, np.stack([rows, rows], 1), cell, poses, np.zeros((1, 8)))


def test_a_problem_has_the_cells_of_its_photos_and_tracks():
    rng = np.random.default_rng(0)
    cell = np.full((5, 30), -1)
    mask = rng.random(cell.shape) < 0.5
    cell[mask] = np.arange(mask.sum())
    tracks = tracks_of(cell)
    for _ in range(20):
        problem = draw(tracks, rng, photos=3, count=12)
        photos = (problem.poses.translations[:, 0] / 3).astype(int)
        assert len(set(photos)) == 3
        row, seen = problem.corner[:, 0].reshape(3, 12), problem.seen.reshape(3, 12) > 0
        assert (seen.sum(0) >= 2).all() or not seen.all(1).any()
        columns = set()
        for track in np.flatnonzero(seen.any(0)):
            of = {
                int(np.flatnonzero((cell == row[k, track]).any(0))[0])
                for k in range(3)
                if seen[k, track]
            }
            assert len(of) == 1
            column = of.pop()
            for k, photo in enumerate(photos):
                assert (
                    (cell[photo, column] == row[k, track])
                    if seen[k, track]
                    else cell[photo, column] == -1
                )
            columns.add(column)
        assert len(columns) == seen.any(0).sum() > 3
        for x in problem.maps:
            np.testing.assert_array_equal(x[:, 0, 0, 0], problem.corner[:, 0])
    with pytest.raises(ValueError, match="photos must be 2 to 5; got 6"):
        draw(tracks, rng, photos=6, count=12)


def test_a_track_with_two_cells_in_a_photo_is_left_out():
    def result(a, b, cells):
        none = np.zeros((0, 2), np.float32)
        return PairResult(
            pair=(a, b),
            cells=np.asarray(cells, np.int32),
            keypoints0=none,
            keypoints1=none,
            plane=np.zeros(len(cells), np.int32),
            homographies=np.zeros((0, 3, 3)),
            num_tentative=0,
            num_dropped=0,
            status=Status.VERIFIED,
        )

    found = [
        result("a", "b", [[1, 5], [2, 6]]),
        result("b", "c", [[5, 9], [6, 8]]),
        result("a", "c", [[3, 8]]),  # with 2 of a, by way of 6 of b
    ]
    photo, cell, track = pose_problems._joined(["a", "b", "c"], found)
    assert sorted(zip(photo, cell, track, strict=True)) == [(0, 1, 0), (1, 5, 0), (2, 9, 0)]
    assert not len(pose_problems._joined(["a", "b"], [])[2])


@pytest.fixture(scope="module")
def room(weights, inputs):  # noqa: F811
    return posed_tracks(weights, *inputs, max_size=320)


@pytest.mark.slow
def test_the_hard_walk_in_a_cell_is_the_keypoint_of_the_photo(weights, inputs, room):  # noqa: F811
    at = np.asarray(jax.jit(functools.partial(walk_in_cells, variant="hard"))(None, room.maps))
    config = dataclasses.replace(preset("paper"), max_size=320)
    assert room.cell.shape[1] > 100
    for image, cells in zip(sorted(inputs[0], key=lambda x: x.name), room.cell, strict=True):
        rows = cells[cells >= 0]
        dense = image_features(weights, image, config=config).dense
        col, row = (room.corner[rows] // 8).astype(int).T
        expected = dense.keypoints[row * dense.fine_grid[1] + col]
        same = (room.corner[rows] + at[rows] == expected).all(1)
        assert same.mean() > 0.99  # rounding may turn a tie


def test_what_has_no_tracks_is_refused(weights, inputs):  # noqa: F811
    images, _, camera = inputs
    with pytest.raises(UserError, match="0 of the photos have a pose; 2 are needed"):
        posed_tracks(weights, images, {}, camera, max_size=320)
