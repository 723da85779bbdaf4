"""Levenberg and Marquardt's iteration for bundle adjustment.

A robust loss is minimised by reweighting: a step is that of least squares with the weights of the
present residuals, which are lower along a residual than across it. Slopes are those of the loss
itself, so the loss is least where they vanish.

Source: Nielsen 1999, "Damping parameter in Marquardt's method".
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.bundle_problem import Loss, Normal, Problem, Scene, normal
from jaxsfm.core.bundle_step import moved
from jaxsfm.core.schur import factor, solve

DAMPING = 1e-4
"""Of the first step, as a share of the diagonal: that of Ceres."""
FORCING = 0.1
"""To which share of the right side conjugate gradients solve a step: that of Ceres."""


class Iteration(NamedTuple):
    """Where the iteration is."""

    scene: Scene
    model: Normal
    """Of the cost, at the scene."""
    damping: Float[Array, ""]
    raising: Float[Array, ""]
    """The factor of the damping if the next step fails."""
    steps: Int[Array, ""]
    """How many steps were tried. Each solves one system."""
    done: Bool[Array, ""]
    """Whether the last step promised less than the tolerance, and less damping would not help."""


def minimise(
    scene: Scene,
    problem: Problem,
    loss: Loss,
    *,
    steps: Int[Array, ""] | int,
    tolerance: Float[Array, ""] | float,
) -> Iteration:
    """The scene after at most so many steps, none of which raises the cost.

    Args:
      tolerance: the iteration ends if a step promises to lower the cost by less than this share, or
        by less than the rounding of the cost or of keypoints of a thousand pixels. A damped step
        says nothing about moves that hardly change the cost, such as the bend of a long row. So
        after one that promises so little the least damping is tried, unless steps with less damping
        have just failed.
    """
    dtype, layout = scene.points.dtype, problem.layout
    eps = float(jnp.finfo(dtype).eps)
    least = eps**0.75
    rounding = (1000 * eps) ** 2 * jnp.sum(problem.weight)

    def tried(state: Iteration) -> Iteration:
        model, first = state.model, state.steps < 0
        made = factor(model, layout, damping=state.damping, tolerance=FORCING)
        by = [-x for x in solve(made, model.slope)]
        scene = moved(state.scene, layout, *by)
        there = normal(scene, problem, loss, exact=False)
        # Of the quadratic model, (-g.x + damping x.diag(H) x) / 2: x solves the damped system.
        held = made.added, state.damping * jnp.diagonal(model.points, axis1=1, axis2=2)
        promised = sum(
            jnp.sum(x * (more * x - g)) / 2
            for x, more, g in zip(by, held, model.slope, strict=True)
        )
        better = first | (made.positive & (there.cost <= model.cost))
        gain = (model.cost - there.cost) / jnp.where(promised > 0, promised, 1.0)
        lowered = state.damping * jnp.clip(1 - (2 * gain - 1) ** 3, 1 / 3, 1)
        lowered = jnp.where(first, state.damping, jnp.maximum(lowered, least))
        scene, there = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), (scene, there), (state.scene, model)
        )
        enough = jnp.maximum(jnp.maximum(tolerance, eps) * there.cost, rounding)
        little = ~first & made.positive & (promised <= enough)
        free = (state.damping <= least) | (state.raising > 2)
        lowered = jnp.where(little, least, lowered)
        return Iteration(
            scene,
            there,
            jnp.where(better, lowered, state.damping * state.raising).astype(dtype),
            jnp.where(better, 2, 2 * state.raising).astype(dtype),
            state.steps + 1,
            little & free,
        )

    # A model of zeros makes a step of zeros, so that the model at the start needs no program of its
    # own.
    zeros = jax.eval_shape(lambda: normal(scene, problem, loss, exact=False))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), zeros)
    damping, raising = (jnp.asarray(x, dtype) for x in (DAMPING, 2))
    state = Iteration(scene, zeros, damping, raising, jnp.int32(-1), jnp.bool_(False))
    return lax.while_loop(lambda s: ~s.done & (s.steps < steps), tried, state)
