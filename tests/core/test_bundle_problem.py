"""Laws of the quadratic model of a bundle adjustment's cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsfm.core.bundle_layout import Free, layout_of
from jaxsfm.core.bundle_problem import Loss, Poses, Problem, Scene, normal
from jaxsfm.core.cameras import intrinsics_of


def curvature(loss: Loss, residual: float, *, exact: bool) -> np.ndarray:
    """Second derivatives (2, 2) of the loss, whose scale is a pixel, in the principal point. The
    residual is along x, and projections are linear, as nothing else moves."""
    params, model = intrinsics_of(["SIMPLE_PINHOLE"], [[100.0, 50.0, 40.0]])
    free = Free(np.zeros((1, 6), bool), np.zeros(1, bool), np.arange(8)[None] % 3 > 0)
    free.params[:, 3:] = False
    rows = np.zeros(1, int), np.zeros(1, int)
    with jax.enable_x64(True):
        layout = layout_of(*rows, free, camera=np.zeros(1, int), model=model)
        poses = Poses(np.eye(3)[None], np.zeros((1, 3)))
        made = Scene(poses, np.asarray([[0.0, 0, 1, 1]]) / np.sqrt(2), params)
        scene, layout = jax.tree.map(jnp.asarray, (made, layout))
        xy = jnp.asarray([[[50.0 - residual, 40.0]]])
        problem = Problem(layout, xy, jnp.ones((1, 1)), jnp.asarray(1.0))
        found = jax.jit(lambda *x: normal(*x, loss, exact=exact))(scene, problem)
    return np.asarray(found.photos)[0, 6:, 6:]


@pytest.mark.parametrize("loss", ["cauchy", "huber"])
@pytest.mark.parametrize("residual", [0.0, 0.3])
def test_near_its_minimum_a_robust_loss_has_its_own_second_derivatives(loss, residual):
    found, expected = (curvature(loss, residual, exact=exact) for exact in (False, True))
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("loss", ["cauchy", "huber"])
def test_far_residuals_are_flatter_along_themselves_and_no_step_more_than_halves_them_beyond(loss):
    along, across = np.diag(curvature(loss, 5.0, exact=False))
    influence = 1 / 26 if loss == "cauchy" else 1 / 5
    np.testing.assert_allclose(across, influence, rtol=1e-12)
    after = 1 - influence / along  # of the residual, by one step
    np.testing.assert_allclose(after, -0.5, rtol=1e-12)
