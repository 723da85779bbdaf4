"""Levenberg and Marquardt's iteration for bundle adjustment.

A robust loss is minimised by reweighting: a step is that of least squares with the weights of the
present residuals. Slopes are those of the loss itself, so the loss is least where they vanish.

Source: Nielsen 1999, "Damping parameter in Marquardt's method".
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core.bundle_problem import Loss, Normal, Problem, Scene, cost, moved, normal
from jaxsfm.core.schur import factor, solve

DAMPING = 1e-4
"""Of the first step, as a share of the diagonal: that of Ceres."""
FORCING = 0.1
"""To which share of the right side conjugate gradients solve a step: that of Ceres."""


class Iteration(NamedTuple):
    """Where the iteration is."""

    scene: Scene
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    raising: Float[Array, ""]
    """The factor of the damping if the next step fails."""
    steps: Int[Array, ""]
    """How many steps were tried. Each solves one system."""
    better: Bool[Array, ""]
    done: Bool[Array, ""]
    """Whether the last step promised less than the tolerance."""


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
        by less than the rounding of the cost or of keypoints of a thousand pixels.
    """
    dtype = scene.points.dtype
    eps = float(jnp.finfo(dtype).eps)
    rounding = (1000 * eps) ** 2 * jnp.sum(problem.weight)

    def tried(model: Normal, state: Iteration) -> Iteration:
        made = factor(model, problem.layout, damping=state.damping, tolerance=FORCING)
        by = [-x for x in solve(made, model.slope)]
        there = moved(state.scene, problem.layout, *by)
        least = cost(there, problem, loss)
        # Of the quadratic model, (-g.x + damping x.diag(H) x) / 2: x solves the damped system.
        held = made.added, state.damping * jnp.diagonal(model.points, axis1=1, axis2=2)
        promised = sum(
            jnp.sum(x * (more * x - g)) / 2
            for x, more, g in zip(by, held, model.slope, strict=True)
        )
        better = made.solved & (least <= state.cost)
        gain = (state.cost - least) / jnp.where(promised > 0, promised, 1.0)
        lowered = jnp.maximum(
            state.damping * jnp.clip(1 - (2 * gain - 1) ** 3, 1 / 3, 1), eps**0.75
        )
        scene, least = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), (there, least), state[:2]
        )
        return Iteration(
            scene,
            least,
            jnp.where(better, lowered, state.damping * state.raising).astype(dtype),
            jnp.where(better, 2, 2 * state.raising).astype(dtype),
            state.steps + 1,
            better,
            made.solved & (promised <= jnp.maximum(jnp.maximum(tolerance, eps) * least, rounding)),
        )

    def step(state: Iteration) -> Iteration:
        model = normal(state.scene, problem, loss, exact=False)
        return lax.while_loop(
            lambda s: ~s.better & ~s.done & (s.steps < steps),
            functools.partial(tried, model),
            state._replace(better=jnp.bool_(False)),
        )

    start = cost(scene, problem, loss)
    damping, raising = (jnp.asarray(x, dtype) for x in (DAMPING, 2))
    never = jnp.bool_(False)
    state = Iteration(scene, start, damping, raising, jnp.int32(0), never, never)
    return lax.while_loop(lambda s: ~s.done & (s.steps < steps), step, state)
