"""The methods that the benchmarks compare: presets, and presets with one idea left out."""

import dataclasses
from collections.abc import Callable

from jaxsfm.config import Config, Keypoints, preset
from jaxsfm.options import Mapper


def _with_pair(config: Config, **changes: int) -> Config:
    return dataclasses.replace(config, pair=dataclasses.replace(config.pair, **changes))


ABLATIONS: dict[str, Callable[[Config], Config]] = {
    "no-octaves": lambda c: dataclasses.replace(c, octaves=1),
    "no-centring": lambda c: dataclasses.replace(c, centred=False),
    "no-enlarging": lambda c: dataclasses.replace(c, enlarge=1.0),
    "no-consensus": lambda c: _with_pair(c, consensus=0),
    "no-competition": lambda c: _with_pair(c, plane_rounds=0),
    "no-closer-looks": lambda c: dataclasses.replace(c, closer_looks=0),
    "no-alignment": lambda c: dataclasses.replace(c, aligned_octaves=0),
    "norm": lambda c: dataclasses.replace(c, keypoints="relocalized"),
    "learned": lambda c: dataclasses.replace(c, keypoints="learned"),
    "alexnet": lambda c: dataclasses.replace(c, backbone="alexnet"),
    "bfloat16": lambda c: dataclasses.replace(c, convolutions="bfloat16"),
    "products-float16": lambda c: dataclasses.replace(c, products="float16"),
    "products-bfloat16": lambda c: dataclasses.replace(c, products="bfloat16"),
    "no-placing": lambda c: dataclasses.replace(
        c, refinement=c.refinement and dataclasses.replace(c.refinement, weak_octaves=0)
    ),
}
"""Changes of a preset, by the name that follows PRESET- in a method's name.

Each change leaves out one idea of the preset or exchanges it for another one. `no-placing` changes
models and leaves matches as they are; `no-alignment` changes the matches of single pairs and leaves
models as they are. `no-closer-looks` changes the matches of single pairs, and leaves photos without
a place where they are.
"""
KEYPOINTS: dict[str, Keypoints] = {"grid": "grid", "reloc": "relocalized", "learned": "learned"}
"""Methods that differ only in the place of a keypoint within its cell."""


NAIVE = "paper-naive"
"""The method that has the settings of `paper` but follows matches down to pixels
(`jaxsfm.core.naive`) instead of relocalizing keypoints."""


def _configs() -> dict[str, Config]:
    paper, default = preset("paper"), preset("default")
    unrefined = dataclasses.replace(default, aligned_octaves=0, closer_looks=0, refinement=None)
    ablated = {
        f"{name}-{idea}": without(preset(name))
        for name in ("default", "robust")
        for idea, without in ABLATIONS.items()
        if without(preset(name)) != preset(name)  # an idea that it does not have
    }
    return {
        "paper-grid": dataclasses.replace(paper, keypoints="grid"),
        "paper-grid-80px": dataclasses.replace(paper, keypoints="grid", threshold_px=80.0),
        "paper": paper,
        NAIVE: paper,
        "paper-learned": dataclasses.replace(paper, keypoints="learned"),
        "paper-k4": dataclasses.replace(paper, children=4),
        "paper-conv4": dataclasses.replace(paper, layers="conv4_3/conv3_3"),
        "paper-pool5": dataclasses.replace(paper, layers="pool5/conv5_3"),
        **{
            name: dataclasses.replace(unrefined, keypoints=keypoints)
            for name, keypoints in KEYPOINTS.items()
        },
        "default": default,
        "robust": preset("robust"),
        **ablated,
    }


CONFIGS = _configs()
"""The configuration of each method.

A method is a preset; the preset `paper` with other keypoints; `grid`, `reloc` or `learned`, which
are the preset `default` without refinement and alignment; or PRESET-IDEA, which is a preset changed
by an entry of `ABLATIONS`. `paper-grid-80px` has the threshold of the authors' experiments without
relocalization: ten cells, because their keypoints were then counted in cells. `paper-k4`,
`paper-conv4` and `paper-pool5` are `paper` with K = 4 or with another pair of layers.
"""
PAIR_METHODS = ("rootsift", *(name for name in CONFIGS if not name.endswith("-no-placing")))
"""The methods of `bench wxbs`.

`rootsift` is COLMAP's own features and matcher with the ratio test, before any geometry. The others
are verified by homographies, and aligned where the method does so, as `jaxsfm match` does.
"""
RUN_METHODS = ("rootsift", *(name for name in CONFIGS if not name.endswith("-no-alignment")))
"""The methods of the benchmarks of whole reconstructions."""
ROOTSIFT, REFINED_ROOTSIFT = "rootsift", "rootsift+refined"
"""The methods that have COLMAP's own features, without and with our refinement."""
LIGHTGLUE = "aliked+lightglue"
"""The method that has keypoints and matches of two trained networks."""
SET_METHODS = (ROOTSIFT, REFINED_ROOTSIFT, LIGHTGLUE, *RUN_METHODS[1:])
"""The methods of the benchmarks of sets of photos."""


MAPPERS: dict[str, Mapper] = {"colmap": "incremental", "colmap-global": "global"}
"""Methods that hand the matches of `default` to COLMAP: every verified pair, to this mapper.

Neither our view graph nor our refinement takes part.
"""
_MAPPED = dataclasses.replace(CONFIGS["default"], view_graph=False, checked=False, refinement=None)
AMBIGUOUS_METHODS = (*SET_METHODS, *MAPPERS)
"""The methods of `bench ambiguous`."""


def method_config(method: str, *, max_size: int | None = None) -> Config:
    """The configuration of a method.

    Args:
      method: one of `CONFIGS` or of `MAPPERS`.
      max_size: the longer side of the working images in pixels; None keeps the method's.

    Raises:
      ValueError: there is no such method.
    """
    configs = CONFIGS | dict.fromkeys(MAPPERS, _MAPPED)
    if method not in configs:
        raise ValueError(f"method must be one of {', '.join(configs)}; got {method!r}")
    config = configs[method]
    return config if max_size is None else dataclasses.replace(config, max_size=max_size)
