"""Configuration: frozen, hashable dataclasses and the named presets.

What fixes an array shape or a branch of a compiled program is *static* and lives in `PairShape`;
numeric thresholds are *traced* (`Thresholds` in `jaxsfm.core.types`), so sweeping them does not
recompile. Imports neither jax nor cv2.
"""

import dataclasses
from typing import Literal, get_args

from jaxsfm.core.pair_shape import PairShape as PairShape

Keypoints = Literal["relocalized", "learned", "grid"]
Convolutions = Literal["float32", "bfloat16"]
BackboneName = Literal["vgg16", "vgg19", "alexnet"]


EXTRACTED_BY = (
    "max_size",
    "enlarge",
    "octaves",
    "centred",
    "backbone",
    "convolutions",
    "keypoints",
)
"""Fields of `Config` that an image's features depend on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refinement:
    """Multi-view keypoint refinement after mapping (`jaxsfm.sfm.refine.passes`)."""

    passes: int = 2
    """Alignment, bundle adjustment and filtering, this many times."""
    radius: int = 7
    """Patches are (2 radius + 1)^2 pixels of the working image."""
    iterations: int = 10
    """Gauss-Newton steps of an alignment."""
    min_score: float = 0.8
    """Least normalised cross-correlation of an observation with its reference patch."""
    max_sigma_px: float = 0.25
    """Largest standard deviation of an observation along its worst direction."""
    max_shift_px: float = 4.0
    """Furthest an observation may end from where the model puts it; half of it in later passes."""
    max_error_px: float = 1.0
    """Largest reprojection error of an observation after bundle adjustment."""
    min_cosine: float = 0.25
    """Views steeper than this towards the surface get no new observations (75 deg)."""
    max_stretch: float = 6.0
    """Nor views that see the surface at an area scale this far from the reference view's."""
    neighbours: int = 16
    """3-D points that give a point its surface normal."""
    weak_octaves: int = 4
    """Sizes (working size, half of it, ...) at which views are placed that have too little to
    align, as a night among days (`jaxsfm.sfm.refine.weak_views`); 0: they keep what the
    mapper gave them."""
    weak_min_score: float = 0.6
    """`min_score` in those views."""

    def __post_init__(self) -> None:
        for name in ("passes", "radius", "iterations", "neighbours"):
            if getattr(self, name) < 1:
                raise ValueError(f"Refinement.{name} must be at least 1; got {getattr(self, name)}")
        for name in ("max_sigma_px", "max_shift_px", "max_error_px", "max_stretch"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Refinement.{name} must be positive; got {getattr(self, name)}")
        if not 0 <= self.weak_octaves <= MAX_OCTAVES:
            raise ValueError(
                f"Refinement.weak_octaves must lie in 0..{MAX_OCTAVES}; got {self.weak_octaves}"
            )
        for name in ("min_score", "min_cosine", "weak_min_score"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"Refinement.{name} must lie in [0, 1); got {getattr(self, name)}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Everything that decides which matches a pair of images has, and what is made of them."""

    max_size: int = 1600
    """Longer side of the working image, pixels; larger images are reduced."""
    enlarge: float = 1.0
    """Smaller images are enlarged up to this factor, no further than `max_size`."""
    octaves: int = 1
    """Sizes at which an image is described: working size, half of it, ..."""
    centred: bool = False
    """Subtract an image's mean descriptor from its descriptors."""
    backbone: BackboneName = "vgg16"
    """The network (`jaxsfm.core.backbones`)."""
    convolutions: Convolutions = "float32"
    """What the network multiplies; sums are float32, then rounded alike. Meant for accelerators
    (where no gain has been measured yet); CPUs round and gain nothing."""
    keypoints: Keypoints = "relocalized"
    """Where a fine cell's keypoint lies: at the pixel it walks to by the largest norms (the paper's
    rule), or by learned scores (`jaxsfm.io.relocalizer`), or at the cell's centre."""
    threshold_px: float = 10.0
    """Inlier radius of a homography, pixels of the working image."""
    min_inliers: int = 26
    """Fewest inliers of an accepted plane."""
    confidence: float = 0.999
    """RANSAC stops when a better plane has been missed with less than 1 - confidence."""
    pair: PairShape = dataclasses.field(default_factory=PairShape)
    aligned_octaves: int = 0
    """Sizes (working size, half of it, ...) at which the matches of a single pair are aligned to a
    fraction of a pixel (`jaxsfm.sfm.refine.pair_alignment`); 0: they stay as they were
    verified. Models have aligned tracks instead."""
    view_graph: bool = False
    """Hand on only pairs that the view graph trusts (`jaxsfm.sfm.view_graph`)."""
    refinement: Refinement | None = None
    """None: the mapper's model is the last."""

    def extraction(self) -> "Config":
        """The part that an image's features depend on; the rest at its defaults."""
        return Config(**{name: getattr(self, name) for name in EXTRACTED_BY})

    def matching(self) -> dict[str, object]:
        """The part that the matches depend on, as plain data."""
        parts = dataclasses.asdict(self)
        del parts["aligned_octaves"], parts["view_graph"], parts["refinement"]
        return parts

    def __post_init__(self) -> None:
        if self.max_size < MIN_SIDE:
            raise ValueError(f"max_size must be at least {MIN_SIDE} pixels; got {self.max_size}")
        if not self.enlarge >= 1:
            raise ValueError(f"enlarge must be at least 1; got {self.enlarge}")
        if not 1 <= self.octaves <= MAX_OCTAVES:
            raise ValueError(f"octaves must lie in 1..{MAX_OCTAVES}; got {self.octaves}")
        if not 0 <= self.aligned_octaves <= MAX_OCTAVES:
            raise ValueError(
                f"aligned_octaves must lie in 0..{MAX_OCTAVES}; got {self.aligned_octaves}"
            )
        if self.backbone not in get_args(BackboneName):
            raise ValueError(
                f"backbone must be one of {get_args(BackboneName)}; got {self.backbone!r}"
            )
        if self.keypoints == "learned" and self.backbone != "vgg16":
            raise ValueError(
                f"keypoints 'learned' are scored from maps of vgg16; got backbone {self.backbone!r}"
            )
        if self.convolutions not in ("float32", "bfloat16"):
            raise ValueError(
                f"convolutions must be 'float32' or 'bfloat16'; got {self.convolutions!r}"
            )
        if self.keypoints not in get_args(Keypoints):
            raise ValueError(
                f"keypoints must be one of {get_args(Keypoints)}; got {self.keypoints!r}"
            )
        if not self.threshold_px > 0:
            raise ValueError(f"threshold_px must be positive; got {self.threshold_px}")
        if self.min_inliers < 4:
            raise ValueError(f"min_inliers must be at least 4; got {self.min_inliers}")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence must lie in (0, 1); got {self.confidence}")


MIN_SIDE = 48
"""Shortest usable side, pixels: three coarse cells, one full window of the coarse-to-fine step."""

MAX_OCTAVES = 4
"""At an eighth of a 1600 px image 12 x 9 coarse cells are left."""

_DEFAULT = Config(
    octaves=4,
    centred=True,
    pair=PairShape(local_refits=4, plane_rounds=5, one_to_one="similarity", consensus=1),
    aligned_octaves=4,
    view_graph=True,
    refinement=Refinement(),
)
PRESETS: dict[str, Config] = {
    "paper": Config(),
    "default": _DEFAULT,
    "robust": dataclasses.replace(
        _DEFAULT,
        enlarge=2.0,
        pair=dataclasses.replace(_DEFAULT.pair, local_refits=10),
    ),
}
"""`paper`: the constants of the authors' code. `default`: octaves, centred descriptors and
neighbourhood consensus (night, seasons, weather), local refits iterated (one refit leaves up to a
fifth of a plane's inliers behind, tests/core/test_ransac.py), planes that compete, the most similar
of a cell's several matches, aligned matches of single pairs, the view graph and the refinement.
`robust`: default, and small images enlarged up to twice (they then take as long as large ones);
planes are refitted until they gain nothing: matches that depend less on the seed."""


def preset(name: str) -> Config:
    """The named preset; ValueError names the ones there are."""
    if name not in PRESETS:
        raise ValueError(f"preset must be one of {sorted(PRESETS)}; got {name!r}")
    return PRESETS[name]
