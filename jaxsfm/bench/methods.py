"""The methods that the benchmarks compare: presets, and presets with one idea left out."""

import dataclasses
from collections.abc import Callable

from jaxsfm.config import PRESETS, Config, Keypoints, preset


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
"""Changes of a preset, by the name that follows PRESET- in a method's name.

Each change leaves out one idea of the preset or exchanges it for another one. `no-placing` changes
models and leaves matches as they are; `no-alignment` changes the matches of single pairs and leaves
models as they are.
"""
ABLATED = tuple(
    f"{name}-{idea}"
    for name in ("default", "robust")
    for idea, without in ABLATIONS.items()
    if without(preset(name)) != preset(name)
)
"""All methods PRESET-IDEA; an idea that a preset does not have cannot be left out."""
KEYPOINTS: dict[str, Keypoints] = {"grid": "grid", "reloc": "relocalized", "learned": "learned"}
"""Methods that differ only in the place of a keypoint within its cell."""
PAIR_ABLATED = tuple(method for method in ABLATED if not method.endswith("-no-placing"))
RUN_ABLATED = tuple(method for method in ABLATED if not method.endswith("-no-alignment"))


def method_config(method: str, *, max_size: int | None = None) -> Config:
    """The configuration of a method.

    Args:
      method: the name of a preset; PRESET-IDEA, which is a preset changed by an entry of
        `ABLATIONS`; `paper-grid` or `paper-learned`, which are the preset `paper` with keypoints at
        cell centres or chosen by learned scores; or `grid`, `reloc` or `learned`, which are the
        preset `default` without refinement and alignment, with keypoints at cell centres, at the
        largest norms or chosen by learned scores.
      max_size: the longer side of the working images in pixels; None keeps the preset's.

    Raises:
      ValueError: there is no such method.
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
