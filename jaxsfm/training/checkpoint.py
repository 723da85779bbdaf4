"""A checkpoint is the state of a training in one safetensors file, from which it can go on."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import PyTree

from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json, write_atomic

State = TypeVar("State")
FORMAT = "jaxsfm training 1"


def save_checkpoint(path: Path, state: PyTree, about: Mapping[str, Json]) -> None:
    """Write the state of a training, a tree of arrays.

    Args:
      about: which training it is, and what it has measured.

    Raises:
      UserError: the file cannot be written.
    """
    leaves = {str(k): np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(state))}
    write_atomic(path, safetensors.numpy.save(leaves, metadata={FORMAT: json.dumps(about)}))


def load_checkpoint(path: Path, like: State) -> tuple[State, dict[str, Json]]:
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
