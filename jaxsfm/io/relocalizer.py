"""Files of learned relocalizers: the parameters of `jaxsfm.core.scores.Scores`.

A file is in the safetensors format. It holds the arrays conv1_2.kernel, conv1_2.bias, conv1_2.out
and conv1_2.place, and the same for pool1 and pool2, all float32. Its metadata says how it was made.
"""

import dataclasses
import functools
import importlib.resources
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxsfm.core.scores import PLACES, WALKED, Head
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.weight_files import Parameters, TensorFile, open_tensors, save_tensors

FORMAT = "jaxsfm relocalizer 1"
SHIPPED = "relocalizer.safetensors"
MAX_HIDDEN = 1024


@dataclasses.dataclass(frozen=True, kw_only=True)
class Relocalizer:
    """Learned scores for keypoints, and how they were made."""

    params: Parameters
    """{'params': {level: the fields of `jaxsfm.core.scores.Head` by name}}, float32."""
    sha256: str
    about: dict[str, Json]
    """The metadata of the file: how the parameters were made."""


def save_relocalizer(path: Path, params: Parameters, about: Mapping[str, Json]) -> None:
    """Write the parameters of `Scores`. The same parameters always give the same bytes."""
    tensors = {
        f"{level}.{part}": params["params"][level][part]
        for level in WALKED
        for part in Head._fields
    }
    save_tensors(path, tensors, marker=FORMAT, about=about)


def load_relocalizer(path: Path) -> Relocalizer:
    """Read and check a relocalizer. Raises UserError if the file is none, or cannot be read."""
    with open_tensors(
        path, marker=FORMAT, what="relocalizer", made_by="jaxsfm train relocalizer"
    ) as file:
        levels = {level: _checked(file, level) for level in WALKED}
        known = {f"{level}.{part}" for level in WALKED for part in Head._fields}
        if unknown := file.shapes.keys() - known:
            raise UserError(f"{path}: {sorted(unknown)[0]} does not belong in a relocalizer")
        return Relocalizer(params={"params": levels}, sha256=file.sha256, about=file.about)


def _checked(file: TensorFile, level: str) -> dict[str, np.ndarray]:
    hidden = int(np.prod(file.shapes.get(f"{level}.bias", (1,))))
    if not 1 <= hidden <= MAX_HIDDEN:
        raise UserError(f"{file.path}: {level} must have 1 to {MAX_HIDDEN} units; got {hidden}")
    shapes = {
        "kernel": (WALKED[level], hidden),
        "bias": (hidden,),
        "out": (hidden,),
        "place": (PLACES[level], PLACES[level]),
    }
    return {part: file.read(f"{level}.{part}", shapes[part]) for part in Head._fields}


@functools.cache
def shipped_relocalizer() -> Relocalizer:
    """Load the relocalizer that comes with jaxsfm (docs/relocalization.md)."""
    with importlib.resources.as_file(importlib.resources.files("jaxsfm") / SHIPPED) as path:
        return load_relocalizer(path)
