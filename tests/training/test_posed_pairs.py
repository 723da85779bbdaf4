"""Epipolar supervision uses right matches of photos with known cameras."""

import numpy as np
import pytest

from jaxsfm.colmap.given_cameras import parse_intrinsics
from jaxsfm.colmap.poses import read_poses
from jaxsfm.errors import UserError
from jaxsfm.matching.pipeline import open_images
from jaxsfm.sfm.epipolar import sampson_error
from jaxsfm.training import photos
from jaxsfm.training.objective import Objective, loss
from jaxsfm.training.photos import Crops
from jaxsfm.training.relocalizer import TrainOptions, start_state, train_step, warped_examples


@pytest.fixture(scope="module")
def inputs(scene):
    images = open_images(scene / "images")[0]
    return images, read_poses(scene / "reference"), parse_intrinsics(str(scene / "K.txt"))


@pytest.fixture(scope="module")
def pairs(weights, inputs):
    return photos.posed_pairs(weights, *inputs, view=64, batch=3, seed=0)


def test_windows_hold_matches_near_their_own_epipolar_lines(weights, pairs):
    """The fundamental matrix is that of the window; shifting the points by two cells shows it."""
    for step in range(4):
        drawn = pairs.draw(step, weights)
        for k in range(3):
            n = int(drawn.cells.weight[k].sum())
            assert n >= 1
            cells = [
                np.asarray(c[k][:n], np.float64) for c in (drawn.cells.cell0, drawn.cells.cell1)
            ]
            assert all(c.min() >= 1 and c.max() <= 6 for c in cells)
            xy = [8 * c[:, ::-1] + 3.5 for c in cells]
            f = np.asarray(drawn.known[k], np.float64)
            assert np.abs(sampson_error(f, *xy)).max() < photos.MAX_ERROR_PX + 0.1
    errors = [_error(pairs, weights, step) for step in range(6)]
    shifted = [_error(pairs, weights, step, shift=16.0) for step in range(6)]
    assert np.mean(errors) < 0.5 * np.mean(shifted)


def _error(pairs, weights, step: int, shift: float = 0.0) -> float:
    drawn = pairs.draw(step, weights)
    n = int(drawn.cells.weight[0].sum())
    xy = [8 * np.asarray(c[0][:n], np.float64)[:, ::-1] + 3.5 for c in drawn.cells[:2]]
    return float(
        np.abs(sampson_error(np.asarray(drawn.known[0], np.float64), xy[0] + shift, xy[1])).mean()
    )


def test_windows_depend_on_the_step_alone(weights, inputs, pairs):
    again = photos.posed_pairs(weights, *inputs, view=64, batch=3, seed=0)
    assert again.digest == pairs.digest
    pairs.draw(0, weights)
    for a, b in zip(pairs.draw(5, weights).cells, again.draw(5, weights).cells, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(pairs.draw(5, weights).known, pairs.draw(6, weights).known)


@pytest.mark.slow
def test_posed_pairs_are_a_loss_of_their_own(weights, inputs, pairs):
    import jax

    options = TrainOptions(steps=2, batch=3, view=64, crop=128, hidden=4)
    drawn, others = pairs.draw(0, weights), pairs.draw(1, weights)
    warped = warped_examples(
        weights.params,
        jax.random.key(0),
        Crops(inputs[0], side=128, seed=0).draw(0, 3),
        preprocessing=weights.preprocessing,
        size=64,
    )
    state = start_state(options)
    value, _ = loss(state.scores, drawn, objective=Objective(), supervision="epipolar")
    new, figures = train_step(state, warped, drawn, options=options)
    assert float(figures["epipolar"]) == pytest.approx(float(value), rel=1e-4)
    changed, _ = train_step(state, warped, others, options=options)
    assert not jax.tree.all(jax.tree.map(np.array_equal, new.scores, changed.scores))


def test_what_cannot_supervise_is_refused(weights, inputs):
    images, poses, camera = inputs
    few = {images[0].name: poses[images[0].name]}
    with pytest.raises(UserError, match="2 are needed"):
        photos.posed_pairs(weights, images, few, camera, view=64, batch=1, seed=0)
    distorted = parse_intrinsics("SIMPLE_RADIAL:320,160,120,0.1")
    with pytest.raises(UserError, match="pinhole"):
        photos.posed_pairs(weights, images, poses, distorted, view=64, batch=1, seed=0)
