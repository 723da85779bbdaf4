"""The training of a relocalizer's scores, for the command `jaxsfm train relocalizer`.

A checkpoint is the state of a training in one safetensors file, from which it can go on.
"""

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import PyTree
from tqdm import tqdm

from jaxsfm.core.scores import HIDDEN, init_scores
from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.atomic import Json, write_atomic
from jaxsfm.io.extras import extra
from jaxsfm.io.images import ImageFile
from jaxsfm.io.relocalizer import save_relocalizer
from jaxsfm.io.weights import Weights
from jaxsfm.training.objective import (
    Examples,
    Objective,
    loss,
    mean_shares,
    shares,
    warped_examples,
)
from jaxsfm.training.photos import Crops, PosedPairs, split

with extra("train", "jaxsfm train needs"):
    import optax

EVALUATION_BATCHES = 8
"""The number of batches of held-out views on which the progress is measured."""
SAVED_EVERY = 10
"""The number of steps between two checkpoints, of 0.1 MB each."""
EVALUATION_STEP = 1 << 30
"""The held-out views are drawn with step numbers from here on, which no training reaches."""
Tree = TypeVar("Tree")
FORMAT = "jaxsfm training 1"
Progress = list[Mapping[str, Json]]
"""What was measured at each evaluation: the step, the loss and its parts, and the shares."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """The settings of a training. Its result depends on them, the photos and the network."""

    steps: int = 400
    batch: int = 8
    """Pairs of views in a step."""
    view: int = 192
    """Side of a view, pixels."""
    crop: int = 400
    """Side of the crop of a photo from which views are made, pixels."""
    hidden: int = HIDDEN
    """Hidden units of the perceptron of each level."""
    learning_rate: float = 0.01
    """The learning rate at the start; it falls to 0 along a cosine."""
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


class State(NamedTuple):
    """Everything that changes from step to step."""

    scores: PyTree
    """The parameters of `jaxsfm.core.scores.Scores`."""
    optimizer: optax.OptState
    step: np.ndarray
    """int32 (): the number of steps so far."""


def _optimizer(options: TrainOptions) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(options.learning_rate, options.steps))


@functools.partial(jax.jit, static_argnames=("options",))
def train_step(
    state: State, warped: Examples, posed: Examples | None, *, options: TrainOptions
) -> tuple[State, dict[str, jax.Array]]:
    """Make one step of Adam on the loss of warped views, and of posed pairs if there are any.

    Returns: the new state, and figures of the loss before the step.
    """

    def total(scores: dict) -> tuple[jax.Array, dict[str, jax.Array]]:
        value, figures = loss(scores, warped, objective=options.objective)
        if posed is not None:
            of_posed, _ = loss(scores, posed, objective=options.objective, supervision="epipolar")
            value = value + of_posed
            figures = figures | {"epipolar": of_posed}
        return value, figures

    gradient, figures = jax.grad(total, has_aux=True)(state.scores)
    update, optimizer = _optimizer(options).update(gradient, state.optimizer, state.scores)
    scores = optax.apply_updates(state.scores, update)
    return State(scores, optimizer, state.step + 1), figures


def start_state(options: TrainOptions) -> State:
    """Return the state before the first step, in which scores equal squared norms."""
    scores = init_scores(jax.random.key(options.seed), hidden=options.hidden)
    return State(scores, _optimizer(options).init(scores), np.zeros((), np.int32))


def save_checkpoint(path: Path, state: PyTree, about: Mapping[str, Json]) -> None:
    """Write the state of a training, a tree of arrays.

    Args:
      about: which training it is, and what it has measured.

    Raises:
      UserError: the file cannot be written.
    """
    leaves = {str(k): np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(state))}
    write_atomic(path, safetensors.numpy.save(leaves, metadata={FORMAT: json.dumps(about)}))


def load_checkpoint(path: Path, like: Tree) -> tuple[Tree, dict[str, Json]]:
    """Read the state of a training, and what was saved about it.

    Args:
      like: a state with the same structure and shapes.

    Raises:
      UserError: the file is not a checkpoint, or its state has another structure.
    """
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            about = json.loads((file.metadata() or {})[FORMAT])
            leaves = [file.get_tensor(str(k)) for k in range(len(file.keys()))]
    except Exception as error:  # a damaged file can raise more than safetensors' own error
        raise UserError(f"{path}: not a readable checkpoint; delete it to start again") from error
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(like)]
    if [leaf.shape for leaf in leaves] != shapes or not isinstance(about, dict):
        raise UserError(f"{path}: a checkpoint of another training; delete it to start again")
    return jax.tree.unflatten(jax.tree.structure(like), leaves), about


def train_relocalizer(
    weights: Weights,
    images: Sequence[ImageFile],
    out: Path,
    *,
    options: TrainOptions,
    posed: PosedPairs | None = None,
    progress: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> float:
    """Train scores on photos and write them to a file.

    Ten times during the training, the shares of keypoints within 1 and 3 px are measured on photos
    that are held out. A checkpoint is kept beside `out`. After an interruption the same call goes
    on from there, and it gives the same parameters as a training without interruption.

    Args:
      posed: pairs of photos with known cameras, to train on besides.

    Returns: the time that the training took, seconds.

    Raises:
      UserError: there are too few photos, a file cannot be read or written, or the checkpoint
        belongs to another training.
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
                # Both change in one statement, so that no checkpoint has a step without its
                # measurement.
                state, history = new, rows
                bar.update()
                if (step + 1) % SAVED_EVERY == 0:
                    keep()
    except KeyboardInterrupt:
        keep()
        raise
    result = {**about, "held_out": {"norm": norm, "learned": history[-1]}, "history": history}
    save_relocalizer(out, jax.device_get(state.scores), result)
    kept.unlink(missing_ok=True)
    return time.monotonic() - start


def _within(found: dict[str, float]) -> str:
    return f"{found['within_1']:.4f} within 1 px, {found['within_3']:.4f} within 3 px"


def _held_out_examples(
    warp: Callable[..., Examples], held_out: list[ImageFile], options: TrainOptions
) -> list[Examples]:
    """The examples to measure on. They depend on the held-out photos and the options alone."""
    crops = Crops(held_out, side=options.crop, seed=0)
    steps = [EVALUATION_STEP + k for k in range(EVALUATION_BATCHES)]
    return [warp(jax.random.key(step), crops.draw(step, options.batch)) for step in steps]


def _about(
    weights: Weights,
    train: list[ImageFile],
    held_out: list[ImageFile],
    posed: PosedPairs | None,
    options: TrainOptions,
) -> dict[str, Json]:
    """All that the trained parameters depend on."""

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
    kept: Path, options: TrainOptions, about: dict[str, Json], tell: Callable[[str], None]
) -> tuple[State, Progress]:
    """The state and the measurements so far: those of the checkpoint, if there is one."""
    state = start_state(options)
    if not kept.exists():
        return state, []
    found, saved = load_checkpoint(kept, state)
    history = saved.get("history")
    if saved.get("of") != about or not isinstance(history, list):
        raise UserError(
            f"{kept}: the state of another training (other photos or options); "
            "delete it to start again"
        )
    tell(f"going on from step {int(found.step)} ({kept})")
    return jax.tree.map(jnp.asarray, found), [row for row in history if isinstance(row, dict)]
