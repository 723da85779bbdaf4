"""The methods that the benchmarks compare: presets and variants of them, and those of others."""

import dataclasses

from jaxsfm.config import Config, preset
from jaxsfm.options import Mapper

NAIVE = "paper-naive"
"""The method that has the settings of `paper` but follows matches down to pixels
(`jaxsfm.core.naive`) instead of relocalizing keypoints."""


def _configs() -> dict[str, Config]:
    paper, default = preset("paper"), preset("default")
    unrefined = dataclasses.replace(
        default, aligned_octaves=0, max_rectified_planes=0, refinement=None
    )
    return {
        "paper-grid": dataclasses.replace(paper, keypoints="grid"),
        "paper-grid-80px": dataclasses.replace(paper, keypoints="grid", threshold_px=80.0),
        "paper": paper,
        NAIVE: paper,
        "paper-learned": dataclasses.replace(paper, keypoints="learned"),
        "paper-k4": dataclasses.replace(paper, children=4),
        "paper-conv4": dataclasses.replace(paper, layers="conv4_3/conv3_3"),
        "paper-pool5": dataclasses.replace(paper, layers="pool5/conv5_3"),
        "grid": dataclasses.replace(unrefined, keypoints="grid"),
        "reloc": dataclasses.replace(unrefined, keypoints="relocalized"),
        "learned": dataclasses.replace(unrefined, keypoints="learned"),
        "default": default,
        "default-products-float16": dataclasses.replace(default, products="float16"),
        "default-products-bfloat16": dataclasses.replace(default, products="bfloat16"),
        "robust": preset("robust"),
    }


CONFIGS = _configs()
"""The configuration of each method.

A method is a preset; the preset `paper` with other keypoints; the preset `default` with descriptors
of 16 bits; or `grid`, `reloc` or `learned`, which are the preset `default` without refinement and
alignment. `paper-grid-80px` has the threshold of the authors' experiments without relocalization:
ten cells, because their keypoints were then counted in cells. `paper-k4`, `paper-conv4` and
`paper-pool5` are `paper` with K = 4 or with another pair of layers.
"""
ROOTSIFT, REFINED_ROOTSIFT = "rootsift", "rootsift+refined"
"""The methods that have COLMAP's own features, without and with our refinement."""
LIGHTGLUE = "aliked+lightglue"
"""The method that has keypoints and matches of two trained networks."""
METHODS = (ROOTSIFT, *CONFIGS)
"""The methods of `bench wxbs` and of `bench daynight`.

On a pair, `rootsift` is COLMAP's own features and matcher with the ratio test, before any geometry.
The others are verified by homographies, and aligned where the method does so, as `jaxsfm match`
does.
"""
SET_METHODS = (ROOTSIFT, REFINED_ROOTSIFT, LIGHTGLUE, *CONFIGS)
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
