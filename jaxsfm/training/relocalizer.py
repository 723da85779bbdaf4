"""Training of a relocalizer's scores: `jaxsfm train relocalizer`."""

import dataclasses
import functools
import hashlib
import importlib.metadata
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from jaxsfm.core.scores import HIDDEN, init_scores
from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.images import ImageFile
from jaxsfm.io.relocalizer import save_relocalizer
from jaxsfm.io.weights import Weights
from jaxsfm.training.checkpoint import load_checkpoint, save_checkpoint
from jaxsfm.training.objective import (
    Examples,
    Objective,
    loss,
    mean_shares,
    shares,
    warped_examples,
)
from jaxsfm.training.photos import Crops, split
from jaxsfm.training.posed import PosedPairs

EVALUATION_BATCHES = 8
KEPT_EVERY = 10
"""Steps; a file of 0.1 MB."""
EVALUATION_STEP = 1 << 30
"""Crops to measure on are drawn as if by steps from here on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What a training is of, beside the photos and the network."""

    steps: int = 400
    batch: int = 8
    """Pairs of views a step."""
    view: int = 192
    """Side of a view, pixels."""
    crop: int = 400
    """Side of the part of a photo that views are made from, pixels."""
    hidden: int = HIDDEN
    learning_rate: float = 0.01
    """At the start; it falls to 0 along a cosine."""
    epipolar_weight: float = 1.0
    """Of the loss of posed pairs, where there are any."""
    seed: int = 0
    objective: Objective = dataclasses.field(default_factory=Objective)

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "hidden"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}")
        if self.view < 64 or self.view % 16:
            raise ValueError(f"view must be a multiple of 16 and at least 64; got {self.view}")
        if self.crop < self.view:
            raise ValueError(f"crop must be at least the view's {self.view}; got {self.crop}")
        if not 0 < self.learning_rate <= 1:
            raise ValueError(f"learning_rate must lie in (0, 1]; got {self.learning_rate}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must lie in 0 .. 2147483647; got {self.seed}")
        if self.epipolar_weight < 0:
            raise ValueError(f"epipolar_weight must be at least 0; got {self.epipolar_weight}")


class State(NamedTuple):
    """Everything that changes from step to step."""

    scores: Any
    optimizer: Any
    step: np.ndarray


def _optimizer(options: TrainOptions) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(options.learning_rate, options.steps))


@functools.partial(jax.jit, static_argnames=("options",))
def train_step(
    state: State, warped: Examples, posed: Examples | None, *, options: TrainOptions
) -> tuple[State, dict[str, jax.Array]]:
    """One step of Adam on the loss of warped views, and of posed pairs if there are any."""

    def total(scores: dict) -> tuple[jax.Array, dict[str, jax.Array]]:
        value, figures = loss(scores, warped, objective=options.objective)
        if posed is not None:
            of_posed, _ = loss(scores, posed, objective=options.objective, supervision="epipolar")
            value = value + options.epipolar_weight * of_posed
            figures = figures | {"epipolar": of_posed}
        return value, figures

    gradient, figures = jax.grad(total, has_aux=True)(state.scores)
    update, optimizer = _optimizer(options).update(gradient, state.optimizer, state.scores)
    scores = optax.apply_updates(state.scores, update)
    return State(scores, optimizer, state.step + 1), figures


def start_state(options: TrainOptions) -> State:
    """Scores that are squared norms."""
    scores = init_scores(jax.random.key(options.seed), hidden=options.hidden)
    return State(scores, _optimizer(options).init(scores), np.zeros((), np.int32))


def train_relocalizer(
    weights: Weights,
    images: Sequence[ImageFile],
    out: Path,
    *,
    options: TrainOptions,
    posed: PosedPairs | None = None,
    progress: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Train scores on photos and write them to `out`; returns what the file says of itself.

    Ten times in between, the share of keypoints within 1 and 3 px is measured on photos held out.
    The state is kept beside `out` as it goes: the same call goes on after an interruption and gives
    the same parameters as without one.

    Args:
      posed: pairs of photos with known cameras, besides.
      tell: takes a line now and then.

    Raises:
      UserError: too few photos, or the state beside `out` is of another training.
    """
    train, held_out = split(images)
    weights = dataclasses.replace(weights, params=jax.device_put(weights.params))
    crops = Crops(train, side=options.crop, seed=options.seed)
    root = jax.random.key(options.seed)
    warp = functools.partial(
        warped_examples, weights.params, preprocessing=weights.preprocessing, size=options.view
    )
    about = _about(weights, train, held_out, posed, options)
    kept = out.with_name(out.name + ".checkpoint")
    state, history = _resume(kept, options, about, tell)

    measured = _held_out_examples(warp, held_out, options)
    norm = mean_shares([jax.device_get(shares(None, some)) for some in measured])
    tell(f"step    0: {_within(norm)} of held-out views (the norm rule)")

    def keep() -> None:
        save_checkpoint(kept, state, {"of": about, "history": history})

    every = max(1, options.steps // 10)
    start = time.monotonic()
    try:
        with tqdm(
            total=options.steps, initial=int(state.step), unit="step", disable=not progress
        ) as bar:
            while (step := int(state.step)) < options.steps:
                interrupt.check()
                examples = warp(jax.random.fold_in(root, step), crops.draw(step, options.batch))
                real = None if posed is None else posed.draw(step, weights)
                new, figures = train_step(state, examples, real, options=options)
                rows = history
                bar.set_postfix({k: f"{float(v):.3f}" for k, v in figures.items()})
                if (step + 1) % every == 0 or step + 1 == options.steps:
                    found = mean_shares(
                        [jax.device_get(shares(new.scores, some)) for some in measured]
                    )
                    values = {k: round(float(v), 5) for k, v in figures.items()}
                    rows = [*history, {"step": step + 1, **values, **found}]
                    tell(f"step {step + 1:4d}: {_within(found)}, loss {values['loss']:.3f}")
                # Together, so that an interruption never keeps a step without its measurement.
                state, history = new, rows
                bar.update()
                if (step + 1) % KEPT_EVERY == 0:
                    keep()
    except KeyboardInterrupt:
        keep()
        raise
    result = {**about, "held_out": {"norm": norm, "learned": history[-1]}, "history": history}
    save_relocalizer(out, jax.device_get(state.scores), result)
    kept.unlink(missing_ok=True)
    return result | {"seconds": time.monotonic() - start}


def _within(found: dict[str, float]) -> str:
    return f"{found['within_1']:.4f} within 1 px, {found['within_3']:.4f} within 3 px"


def _held_out_examples(
    warp: Callable[..., Examples], held_out: list[ImageFile], options: TrainOptions
) -> list[Examples]:
    """The same for every training that holds the same photos out."""
    crops = Crops(held_out, side=options.crop, seed=0)
    steps = [EVALUATION_STEP + k for k in range(EVALUATION_BATCHES)]
    return [warp(jax.random.key(step), crops.draw(step, options.batch)) for step in steps]


def _about(
    weights: Weights,
    train: list[ImageFile],
    held_out: list[ImageFile],
    posed: PosedPairs | None,
    options: TrainOptions,
) -> dict[str, Any]:
    """What the trained parameters depend on, as plain JSON."""

    def digest(images: list[ImageFile]) -> str:
        return hashlib.sha256("".join(i.sha256 for i in images).encode()).hexdigest()

    return {
        "version": importlib.metadata.version("jaxsfm"),
        "weights": weights.sha256,
        "walked": weights.walked,
        "options": dataclasses.asdict(options),
        "photos": {"trained_on": len(train), "held_out": len(held_out)},
        "photos_sha256": digest(train),
        "posed": None if posed is None else posed.digest,
    }


def _resume(
    kept: Path, options: TrainOptions, about: dict[str, Any], tell: Callable[[str], None]
) -> tuple[State, list[dict[str, Any]]]:
    state = start_state(options)
    if not kept.exists():
        return state, []
    found, of = load_checkpoint(kept, state)
    if of.get("of") != about:
        raise UserError(
            f"{kept}: the state of another training (other photos or options); "
            "delete it to start again"
        )
    tell(f"going on from step {int(found.step)} ({kept})")
    return jax.tree.map(jnp.asarray, found), list(of["history"])
