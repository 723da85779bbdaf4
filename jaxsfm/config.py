"""Configuration: frozen, hashable dataclasses and the named presets.

Settings that fix an array shape or a branch of a compiled program are static and live in
`PairShape`. Numeric thresholds are traced (`Thresholds` in `jaxsfm.core.types`), so other values do
not recompile a program. This module imports neither jax nor cv2.
"""

import dataclasses
from typing import Literal, get_args

from jaxsfm.core.pair_shape import FINE_STRIDES, PAPER_LAYERS, Layers, Products
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
    "layers",
    "keypoints",
    "children",
    "walked_levels",
)
"""Fields of `Config` that the features of an image depend on."""

LATER_SETTINGS = (
    "low_resolution",
    "low_resolution_share",
    "aligned_octaves",
    "max_rectified_planes",
    "view_graph",
    "checked",
    "refinement",
)
"""Fields of `Config` that the matches of a run do not depend on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refinement:
    """Multi-view keypoint refinement after mapping (`jaxsfm.sfm.refine.passes`)."""

    passes: int = 2
    """How many times alignment, bundle adjustment and filtering are repeated."""
    radius: int = 7
    """Patches are (2 radius + 1)^2 pixels of the working image."""
    iterations: int = 8
    """Number of steps of an alignment."""
    min_score: float = 0.8
    """Least normalised cross-correlation of an observation with its reference patch."""
    max_sigma_px: float = 0.25
    """Largest standard deviation of an observation along its least certain direction."""
    max_shift_px: float = 4.0
    """Largest distance of an aligned observation from where the model puts it; half of it in later
    passes."""
    max_error_px: float = 1.0
    """Largest reprojection error of an observation after bundle adjustment."""
    min_cosine: float = 0.25
    """Smallest cosine between a view's direction and the surface normal for new observations (75
    deg)."""
    max_stretch: float = 6.0
    """Largest ratio between the areas at which a view and the reference view see the surface, for
    new observations."""
    most_views: int = 12
    """New observations of a point are tried in so few views that it has at most this many, that of
    its patch included. 0: in all views that could see it, which in a video are hundreds."""
    neighbours: int = 16
    """Number of 3-D points from which the surface normal at a point is estimated."""
    weak_octaves: int = 4
    """Number of sizes (working size, half of it, ...) at which weak views are registered. These are
    views with too few aligned observations, as a night photo among day photos
    (`jaxsfm.sfm.refine.weak_views`). With 0 they keep the pose of the mapper."""
    weak_min_score: float = 0.6
    """`min_score` in weak views."""

    @property
    def patch_side(self) -> int:
        """The side of a patch, pixels."""
        return 2 * self.radius + 1

    def in_all_views(self) -> "Refinement":
        """The same settings, but points are looked for in all views that could see them."""
        return dataclasses.replace(self, most_views=0)

    def __post_init__(self) -> None:
        for name in ("passes", "radius", "iterations", "neighbours"):
            if getattr(self, name) < 1:
                raise ValueError(f"Refinement.{name} must be at least 1; got {getattr(self, name)}")
        for name in ("max_sigma_px", "max_shift_px", "max_error_px", "max_stretch"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Refinement.{name} must be positive; got {getattr(self, name)}")
        if self.most_views < 0:
            raise ValueError(f"Refinement.most_views must be at least 0; got {self.most_views}")
        if not 0 <= self.weak_octaves <= MAX_OCTAVES:
            raise ValueError(
                f"Refinement.weak_octaves must lie in 0..{MAX_OCTAVES}; got {self.weak_octaves}"
            )
        for name in ("min_score", "min_cosine", "weak_min_score"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"Refinement.{name} must lie in [0, 1); got {getattr(self, name)}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """The settings of matching and of what follows it."""

    max_size: int = 1600
    """Longer side of the working image, pixels; larger images are reduced."""
    enlarge: float = 1.0
    """Smaller images are enlarged by up to this factor, but not beyond `max_size`."""
    low_resolution: int | None = None
    """Longer side of the working image, pixels, at which a run describes and matches its photos.
    Only photos that this leaves without a place are matched at `max_size`, or all photos if it
    gives no model (`jaxsfm.runs.run_photos`). The refinement works at `max_size` in any case. None,
    or without a refinement: photos are described at `max_size` from the beginning."""
    low_resolution_share: float = 1.0
    """Where `low_resolution` hardly reduces the median photo: this share of its longer side
    instead."""
    octaves: int = 1
    """Number of sizes at which an image is described: working size, half of it, ..."""
    centred: bool = False
    """Whether the mean descriptor of an image is subtracted from its descriptors."""
    backbone: BackboneName = "vgg16"
    """The network (`jaxsfm.core.features`)."""
    convolutions: Convolutions = "float32"
    """Type of the operands of the network's convolutions. Sums are float32 and are then rounded to
    this type. bfloat16 is meant for accelerators (an H100 describes 13 times as many photos a
    second); on CPUs it only rounds."""
    products: Products = "float32"
    """Type of the descriptors whose products decide which cells match. Sums are float32. The types
    of 16 bits halve the memory of a photo's joined descriptors. Accelerators also multiply them
    faster; CPUs convert them to float32 first."""
    keypoints: Keypoints = "relocalized"
    """Where the keypoint of a fine cell lies: at the pixel that it walks to by the largest norms
    (the rule of the paper) or by learned scores (`jaxsfm.io.relocalizer`), or at the centre of the
    cell."""
    layers: Layers = PAPER_LAYERS
    """The layers of the coarse and of the fine descriptors. The paper's have cells of 16 and of 8
    pixels. conv4_3/conv3_3 has cells of 8 and 4 pixels, so matching a pair takes about 16 times as
    long; pool5/conv5_3 has cells of 32 and 16 pixels. Maps of convolutions are not rectified."""
    children: int = 2
    """Number of children per axis among which a keypoint is relocalized at each level (K in the
    paper). With more than two, keypoints of neighbouring cells may coincide."""
    walked_levels: int | None = None
    """The number of levels that a keypoint is relocalized in. None stands for all of them, down to
    conv1_2. With fewer, the keypoint lies at the centre of the cell where it ends; with 0, at the
    centre of its fine cell, as with keypoints="grid"."""
    threshold_px: float = 10.0
    """Largest transfer error of an inlier of a homography, pixels of the working image."""
    min_inliers: int = 26
    """Smallest number of inliers of a plane."""
    confidence: float = 0.999
    """RANSAC stops when the probability of having missed a better plane is below 1 - confidence."""
    pair: PairShape = dataclasses.field(default_factory=PairShape)
    aligned_octaves: int = 0
    """Number of sizes (working size, half of it, ...) at which the matches of a single pair are
    aligned to a fraction of a pixel (`jaxsfm.sfm.refine.pair_alignment`). With 0 they stay as they
    were verified. In models the tracks are aligned instead."""
    max_rectified_planes: int = 0
    """How many planes of a single pair are rectified and matched again, at most, unless its
    first pass is strong (`jaxsfm.sfm.two_photos`). With 0 there is one pass only: no other scale
    or turn is tried either."""
    view_graph: bool = False
    """Whether only pairs that the view graph trusts are given to the mapper
    (`jaxsfm.sfm.view_graph`)."""
    checked: bool = False
    """Whether models are checked for photos that contradict each other, and made again without the
    pairs that joined them (`jaxsfm.sfm.check`)."""
    refinement: Refinement | None = None
    """Settings of the refinement. With `None` the model of the mapper is not refined."""

    @property
    def fine_stride(self) -> int:
        """Side of a fine cell, pixels of the working image; a coarse cell is twice as long."""
        return FINE_STRIDES[self.layers]

    def extraction(self) -> "Config":
        """The settings that the features of an image depend on; the others have their defaults."""
        return Config(**{name: getattr(self, name) for name in EXTRACTED_BY})

    def matching(self) -> dict[str, object]:
        """The settings that matches depend on, as plain data."""
        parts = dataclasses.asdict(self)
        for later in LATER_SETTINGS:
            del parts[later]
        return parts

    def at_low_resolution(self, median: float) -> "Config":
        """The settings of low-resolution matching of working images whose median longer side is
        `median` pixels; these settings if there is none."""
        size = self.max_size
        if self.low_resolution is not None and self.refinement is not None:
            size = min(self.low_resolution, size)
            if self.low_resolution_share < 1 and median < WORTH * size:
                steps = int(self.low_resolution_share * median / LOW_RESOLUTION_STEP)
                size = min(size, max(steps * LOW_RESOLUTION_STEP, LEAST_LOW_RESOLUTION))
        return dataclasses.replace(self, max_size=size, low_resolution=None)

    def __post_init__(self) -> None:
        if self.max_size < MIN_SIDE:
            raise ValueError(f"max_size must be at least {MIN_SIDE} pixels; got {self.max_size}")
        if self.low_resolution is not None and self.low_resolution < MIN_SIDE:
            raise ValueError(
                f"low_resolution must be at least {MIN_SIDE} pixels; got {self.low_resolution}"
            )
        if not 0 < self.low_resolution_share <= 1:
            raise ValueError(
                f"low_resolution_share must lie in (0, 1]; got {self.low_resolution_share}"
            )
        if not self.enlarge >= 1:
            raise ValueError(f"enlarge must be at least 1; got {self.enlarge}")
        if self.max_rectified_planes < 0:
            raise ValueError(
                f"max_rectified_planes must be at least 0; got {self.max_rectified_planes}"
            )
        for name, least in (("octaves", 1), ("aligned_octaves", 0)):
            count = getattr(self, name)
            if not least <= count <= MAX_OCTAVES:
                raise ValueError(f"{name} must lie in {least}..{MAX_OCTAVES}; got {count}")
        for name, words in (
            ("backbone", get_args(BackboneName)),
            ("convolutions", get_args(Convolutions)),
            ("products", get_args(Products)),
            ("keypoints", get_args(Keypoints)),
            ("layers", get_args(Layers)),
        ):
            if getattr(self, name) not in words:
                raise ValueError(f"{name} must be one of {words}; got {getattr(self, name)!r}")
        if self.keypoints == "learned" and self.backbone != "vgg16":
            raise ValueError(
                f"keypoints 'learned' are scored from maps of vgg16; got backbone {self.backbone!r}"
            )
        if self.layers != PAPER_LAYERS:
            if self.backbone == "alexnet" or self.keypoints == "learned":
                raise ValueError(
                    "layers other than pool4/pool3 need a VGG and keypoints that are not learned; "
                    f"got {self.layers!r} of {self.backbone} with {self.keypoints!r}"
                )
        if self.children < 2 or self.children % 2:
            raise ValueError(f"children must be even and at least 2; got {self.children}")
        if self.walked_levels is not None and self.walked_levels < 0:
            raise ValueError(f"walked_levels must be at least 0; got {self.walked_levels}")
        if not self.threshold_px > 0:
            raise ValueError(f"threshold_px must be positive; got {self.threshold_px}")
        if self.min_inliers < 4:
            raise ValueError(f"min_inliers must be at least 4; got {self.min_inliers}")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence must lie in (0, 1); got {self.confidence}")


MIN_SIDE = 48
"""Shortest usable side, pixels: three coarse cells, one window of the coarse-to-fine step."""

WORTH = 1.25
"""Low-resolution matching is not worth its time if the median photo is reduced less than by this
factor."""
LEAST_LOW_RESOLUTION, LOW_RESOLUTION_STEP = 480, 80
"""Pixels. By its share, the low resolution is not smaller than the first number. It is a multiple
of the second one, so that a few photos more seldom change its size, and matches are used again."""

MAX_OCTAVES = 4
"""Largest number of octaves. At an eighth of 1600 px there are only 12 x 9 coarse cells left."""

_DEFAULT = Config(
    low_resolution=800,
    low_resolution_share=0.625,
    octaves=4,
    centred=True,
    pair=PairShape(local_refits=4, plane_rounds=5, one_to_one="similarity", consensus=1),
    aligned_octaves=4,
    max_rectified_planes=4,
    view_graph=True,
    checked=True,
    refinement=Refinement(),
)
PRESETS: dict[str, Config] = {
    "paper": Config(),
    "default": _DEFAULT,
    "robust": dataclasses.replace(
        _DEFAULT,
        enlarge=2.0,
        low_resolution=None,
        pair=dataclasses.replace(_DEFAULT.pair, local_refits=10),
    ),
}
"""The named presets.

- `paper` has the constants of the authors' code.
- `default` first describes the photos of a run at about half the size. It adds octaves, centred
  descriptors and neighbourhood consensus (for night, seasons and weather), repeated local refits
  (one refit leaves up to a fifth of a plane's inliers behind, tests/core/test_ransac.py), planes
  that compete, the most similar of several matches of a cell, aligned matches of single pairs, the
  view graph, the check and the refinement.
- `robust` describes all photos at full size and enlarges small ones up to twice, so that they take
  as long as large ones. It refits planes until they gain nothing, so that matches depend less on
  the seed.
"""


def preset(name: str) -> Config:
    """The preset of this name; ValueError, which names the presets, if there is none."""
    if name not in PRESETS:
        raise ValueError(f"preset must be one of {sorted(PRESETS)}; got {name!r}")
    return PRESETS[name]
