"""What the benchmarks share: methods, figures, tables, JSON."""

import dataclasses
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsfm.config import PRESETS, Config, Keypoints, preset
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.images import ImageFile, inspect_image

Keep = Callable[[dict[str, Any]], None]
"""Takes the figures so far, after every row: nothing measured is lost."""


def _with_pair(config: Config, **changes: int) -> Config:
    return dataclasses.replace(config, pair=dataclasses.replace(config.pair, **changes))


ABLATIONS: dict[str, Callable[[Config], Config]] = {
    "no-octaves": lambda c: dataclasses.replace(c, octaves=1),
    "no-centring": lambda c: dataclasses.replace(c, centred=False),
    "no-enlarging": lambda c: dataclasses.replace(c, enlarge=1.0),
    "no-consensus": lambda c: _with_pair(c, consensus=0),
    "no-competition": lambda c: _with_pair(c, plane_rounds=0),
    "no-alignment": lambda c: dataclasses.replace(c, aligned_octaves=0),
    "norm": lambda c: dataclasses.replace(c, keypoints="relocalized"),
    "learned": lambda c: dataclasses.replace(c, keypoints="learned"),
    "alexnet": lambda c: dataclasses.replace(c, backbone="alexnet"),
    "bfloat16": lambda c: dataclasses.replace(c, convolutions="bfloat16"),
    "no-placing": lambda c: dataclasses.replace(
        c, refinement=c.refinement and dataclasses.replace(c.refinement, weak_octaves=0)
    ),
}
"""One idea left out of a preset, or exchanged: METHOD-IDEA. Without placing models change, not
matches; without alignment matches of single pairs, not models."""
ABLATED = tuple(
    f"{name}-{idea}"
    for name in ("default", "robust")
    for idea, without in ABLATIONS.items()
    if without(preset(name)) != preset(name)
)
KEYPOINTS: dict[str, Keypoints] = {"grid": "grid", "reloc": "relocalized", "learned": "learned"}
"""Methods that differ in where keypoints lie."""
PAIR_ABLATED = tuple(method for method in ABLATED if not method.endswith("-no-placing"))
RUN_ABLATED = tuple(method for method in ABLATED if not method.endswith("-no-alignment"))


def method_config(method: str, *, max_size: int | None = None) -> Config:
    """A preset by its name; PRESET-IDEA: without that idea (`ABLATIONS`); paper-grid, -learned:
    paper at cell centres, by learned scores; grid, reloc and learned: the default preset without
    refinement and alignment, at cell centres, relocalized by norms, by learned scores.

    Args:
      max_size: longer side of the working images, pixels; None: the preset's.
    """
    if method in PRESETS:
        config = preset(method)
    elif method in ABLATED:
        name, _, idea = method.partition("-")
        config = ABLATIONS[idea](preset(name))
    elif method in ("paper-grid", "paper-learned"):
        keypoints = KEYPOINTS[method.partition("-")[2]]
        config = dataclasses.replace(preset("paper"), keypoints=keypoints)
    elif method in KEYPOINTS:
        config = dataclasses.replace(
            preset("default"), aligned_octaves=0, refinement=None, keypoints=KEYPOINTS[method]
        )
    else:
        raise ValueError(
            "method must be a preset, PRESET-IDEA, paper-grid, paper-learned or one of "
            f"{', '.join(KEYPOINTS)}; got {method!r}"
        )
    return config if max_size is None else dataclasses.replace(config, max_size=max_size)


def choose_methods(names: Sequence[str], known: Sequence[str]) -> list[str]:
    """`names` in the order of `known`.

    Raises:
      UserError: none, or one that is not known.
    """
    if not names:
        raise UserError("--methods: none given")
    if unknown := [name for name in names if name not in known]:
        raise UserError(f"--methods: no method {unknown[0]!r}; there are {', '.join(known)}")
    return [name for name in known if name in names]


def choose_sets(found: dict[str, Path], names: Sequence[str] | None, root: Path) -> list[Path]:
    """The named sets, or all by name.

    Raises:
      UserError: one of `names` is not there.
    """
    if names is None:
        return [found[name] for name in sorted(found)]
    if not names:
        raise UserError("--sets: none given")
    if unknown := [name for name in names if name not in found]:
        raise UserError(f"--sets: no set {unknown[0]!r} in {root} (there: {sorted(found)})")
    return [found[name] for name in names]


def check_root(root: Path) -> None:
    """Raises UserError unless `root` is a folder."""
    if not root.is_dir():
        raise UserError(f"--root {root}: no such folder")


def read_rows(path: Path, columns: int, what: str) -> np.ndarray:
    """A text file of finite numbers, float64 (n, columns).

    Args:
      what: the file's rows in words, for the error.

    Raises:
      UserError: something else is in it, or nothing.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = np.asarray([[float(v) for v in line.split()] for line in lines if line.strip()])
    except (OSError, ValueError) as error:
        raise UserError(f"--root: {path} cannot be read; expected {what}") from error
    if rows.ndim != 2 or rows.shape[1] != columns or not np.isfinite(rows).all():
        raise UserError(f"--root: {path} must hold {what}")
    return rows


def usable_image(path: Path, *, name: str | None = None) -> ImageFile:
    """The image, called `name` (default: the file's).

    Raises:
      UserError: it cannot be used; names the whole path.
    """
    return dataclasses.replace(inspect_image(path, name=str(path)), name=name or path.name)


def spread(values: Iterable[float]) -> dict[str, float]:
    """Mean, least and largest of the values over seeds."""
    array = np.asarray(list(values), np.float64)
    return {"mean": float(array.mean()), "min": float(array.min()), "max": float(array.max())}


def write_json(path: Path, result: dict[str, Any]) -> None:
    """The figures as JSON."""
    write_atomic(path, json.dumps(result, indent=1, allow_nan=False).encode())
