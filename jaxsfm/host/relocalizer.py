"""Learned relocalizers: parameters of `jaxsfm.core.scores.Scores` in safetensors files.

A file holds conv1_2.kernel, conv1_2.bias, conv1_2.out, conv1_2.place and the same of pool1 and of
pool2, float32, and says in its metadata how it was made. Nothing in it can run code.
"""

import dataclasses
import functools
import hashlib
import importlib.resources
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from jaxsfm.core.scores import PLACES, WALKED, Head
from jaxsfm.errors import UserError
from jaxsfm.host.workfolder import write_atomic

FORMAT = "jaxsfm relocalizer 1"
SHIPPED = "relocalizer.safetensors"
MAX_HIDDEN = 1024


@dataclasses.dataclass(frozen=True, kw_only=True)
class Relocalizer:
    """Learned scores and what is known of them."""

    params: dict[str, Any]
    """{'params': {level: `jaxsfm.core.scores.Head`'s fields by name}}, float32."""
    sha256: str
    about: dict[str, Any]
    """The file's metadata: how the parameters were made."""


def save_relocalizer(path: Path, params: Mapping[str, Any], about: Mapping[str, Any]) -> None:
    """Write parameters of `Scores`; the same ones give the same bytes.

    Raises:
      UserError: the file cannot be written.
    """
    tensors = {
        f"{level}.{part}": np.ascontiguousarray(params["params"][level][part], np.float32)
        for level in WALKED
        for part in Head._fields
    }
    # One entry: safetensors writes several in changing order.
    metadata = {FORMAT: json.dumps(about, sort_keys=True)}
    data = safetensors.numpy.save(tensors, metadata=metadata)
    try:
        write_atomic(path, data)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from error


def load_relocalizer(path: Path) -> Relocalizer:
    """Read and check a relocalizer.

    Raises:
      UserError: no such file, or not a relocalizer.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot read the relocalizer ({error.strerror})") from error
    try:
        tensors = safetensors.numpy.load(data)
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
        about = json.loads(metadata.get(FORMAT, "{}"))
    except Exception as error:  # a damaged file can raise more than safetensors' own error
        raise UserError(f"{path}: not a readable safetensors file ({error})") from error
    if FORMAT not in metadata or not isinstance(about, dict):
        raise UserError(f"{path}: not a relocalizer; 'jaxsfm train relocalizer' makes them")
    levels = {level: _checked(tensors, level, path) for level in WALKED}
    if unknown := tensors.keys() - {f"{level}.{part}" for level in WALKED for part in Head._fields}:
        raise UserError(f"{path}: {sorted(unknown)[0]} does not belong in a relocalizer")
    digest = hashlib.sha256(data).hexdigest()
    return Relocalizer(params={"params": levels}, sha256=digest, about=about)


def _checked(tensors: dict[str, np.ndarray], level: str, path: Path) -> dict[str, np.ndarray]:
    try:
        parts = {part: tensors[f"{level}.{part}"] for part in Head._fields}
    except KeyError as error:
        raise UserError(f"{path}: {error.args[0]} is missing") from error
    hidden = parts["bias"].size
    if not 1 <= hidden <= MAX_HIDDEN:
        raise UserError(f"{path}: {level} must have 1 to {MAX_HIDDEN} units; got {hidden}")
    shapes = {
        "kernel": (WALKED[level], hidden),
        "bias": (hidden,),
        "out": (hidden,),
        "place": (PLACES[level], PLACES[level]),
    }
    for part, shape in shapes.items():
        array = parts[part]
        if array.shape != shape or array.dtype != np.float32:
            raise UserError(
                f"{path}: {level}.{part} must be float32 {shape}; got {array.dtype} {array.shape}"
            )
        if not np.isfinite(array).all():
            raise UserError(f"{path}: {level}.{part} has values that are not finite")
    return parts


@functools.cache
def shipped_relocalizer() -> Relocalizer:
    """The one that comes with jaxsfm; docs/relocalization.md tells how it was made."""
    with importlib.resources.as_file(importlib.resources.files("jaxsfm") / SHIPPED) as path:
        return load_relocalizer(path)
