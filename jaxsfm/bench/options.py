"""The options of the benchmarks' commands, each declared once; `jaxsfm.cli` reads them.

Nothing heavy is imported here, so that `jaxsfm bench NAME --help` is quick.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from jaxsfm.config import MIN_SIDE
from jaxsfm.errors import UserError
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice

QUARTER_TURNS = ("0", "90", "180", "270")


def split_names(values: Sequence[str]) -> list[str]:
    """Names separated by commas, blanks or both."""
    return [name for value in values for name in value.split(",") if name]


def whole_numbers(values: Sequence[str], option: str) -> list[int]:
    """Different numbers of at least 1, separated by commas, blanks or both.

    Raises:
      UserError: there is no number, or something else.
    """
    texts = split_names(values)
    if not texts:
        raise UserError(f"{option}: none given")
    for text in texts:
        if not (text.isascii() and text.isdigit() and int(text)):
            raise UserError(f"{option}: {text!r} is not a whole number of at least 1")
    return list(dict.fromkeys(map(int, texts)))


def check_side(size: int, option: str) -> None:
    """Raise UserError for a working size that is too small."""
    if size < MIN_SIDE:
        raise UserError(f"{option} must be at least {MIN_SIDE} pixels; got {size}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Options of every benchmark. All options raise UserError for values that cannot be used."""

    root: Path | None
    """Folder of the data."""
    methods: tuple[str, ...]
    """Methods to compare, separated by commas or blanks."""
    json: Path | None = None
    """Write all figures to this file."""

    def chosen_methods(self, known: Sequence[str]) -> list[str]:
        """The names in `methods`, in the order of `known`.

        Raises:
          UserError: there is no name, or one that is not in `known`.
        """
        names = split_names(self.methods)
        if not names:
            raise UserError("--methods: none given")
        if unknown := [name for name in names if name not in known]:
            raise UserError(f"--methods: no method {unknown[0]!r}; there are {', '.join(known)}")
        return [name for name in known if name in names]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SetOptions(BenchOptions):
    sets: tuple[str, ...] | None = None
    """Names of the sets to use, separated by commas or blanks. Without it, all sets."""

    def chosen_sets(self) -> list[str] | None:
        """The names in `sets`; None stands for all."""
        return None if self.sets is None else split_names(self.sets)


@dataclasses.dataclass(frozen=True, kw_only=True)
class NetworkOptions(BenchOptions):
    network: WeightsChoice = USUAL_WEIGHTS
    """Which files the network's parameters are read from."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SeedOptions(BenchOptions):
    seeds: int = 5
    """How often each method is run, with seeds 0, 1, ..."""

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise UserError(f"--seeds must be at least 1; got {self.seeds}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanesOptions(SetOptions, SeedOptions):
    """Options of `bench planes`."""

    root: Path
    """Folder of the points: NAME_pts.txt, with rows of x1 y1 1 x2 y2 1 label."""
    methods: tuple[str, ...] = ("paper,default",)
    """Presets to compare, separated by commas or blanks."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WarpsOptions(NetworkOptions, SeedOptions):
    """Options of `bench warps`."""

    root: Path
    """Folder of any photos; sub-folders are included."""
    methods: tuple[str, ...] = ("norm,learned",)
    """Rules to compare, separated by commas or blanks: norm (the paper's rule), learned."""
    seeds: int = 5
    """Number of sets of 64 pairs of views, made with seeds 0, 1, ..."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairOptions(SetOptions, NetworkOptions, SeedOptions):
    """Options of the benchmarks of image pairs.

    Attributes:
      methods: Methods to compare, separated by commas or blanks. rootsift: COLMAP's own features.
        paper, default, robust: the presets. paper-learned: the preset paper with keypoints at the
        largest learned scores. paper-naive, paper-k4, paper-conv4, paper-pool5: as in bench
        strecha. grid, reloc, learned: the preset default without alignment;
        keypoints are at the centres of cells (grid), at the largest norms (reloc) or at the largest
        learned scores (learned). PRESET-no-IDEA: default or robust without one idea, which is
        octaves, centring, consensus, competition, closer-looks or alignment; for robust also
        enlarging.
        PRESET-norm, PRESET-learned, PRESET-alexnet, PRESET-bfloat16: default or robust with this
        keypoint rule, network or number format of the network. PRESET-products-float16,
        PRESET-products-bfloat16: with descriptors of this type.
      max_size: Limit for the longer side of a photo, in pixels. Without it, that of the preset.
    """

    methods: tuple[str, ...] = ("rootsift,paper,default,robust",)
    max_size: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_size is not None:
            check_side(self.max_size, "--max-size")


@dataclasses.dataclass(frozen=True, kw_only=True)
class WxbsOptions(PairOptions):
    """Options of `bench wxbs`.

    Attributes:
      root: Folder of the categories: CATEGORY/NAME/{01,02}.png and corrs.txt.
      sets: CATEGORY or CATEGORY/NAME, separated by commas or blanks. Without it, all pairs.
      protocol: How matches are judged. ours: the best of five fundamental matrices, limits of 1 to
        20 px. lo: as published for other methods, with one run of MAGSAC++ (0.25 px, 100,000
        iterations) and limits of 0 to 10 px.
    """

    root: Path
    sets: tuple[str, ...] | None = None
    protocol: Literal["ours", "lo"] = "ours"


@dataclasses.dataclass(frozen=True, kw_only=True)
class HomographyOptions(PairOptions):
    """Options of `bench homography`.

    Attributes:
      root: Folder of the sequences. A sequence has SEQUENCE/img1.png and H1to2p (or .xml), or
        SEQUENCE/1.ppm and H_1_2.
    """

    root: Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class TurnsOptions(PairOptions):
    """Options of `bench turns`.

    Attributes:
      root: Folder of any photos; sub-folders are included.
      methods: Methods to compare, as in bench wxbs.
      sets: Sub-folders to use, such as SET/images, separated by commas or blanks. Without it, all.
      every: Each so many photos is used.
      turns: Angles by which a copy is turned to the left, degrees, separated by commas or blanks.
      scales: How much larger things are in the copy than in the photo, separated by commas or
        blanks. The photo is reduced for scales above 1.
      seeds: How often each method is run, with seeds 0, 1, ...
    """

    root: Path
    methods: tuple[str, ...] = ("default-no-closer-looks,default",)
    every: int = 1
    turns: tuple[str, ...] = ("0,90,180,270",)
    scales: tuple[str, ...] = ("0.25,0.5,1,2,4",)
    seeds: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.every < 1:
            raise UserError(f"--every must be at least 1; got {self.every}")
        self.chosen_quarters()
        self.chosen_scales()

    def chosen_quarters(self) -> list[int]:
        """The turns as numbers of quarters, 0 to 3.

        Raises:
          UserError: a turn is not 0, 90, 180 or 270.
        """
        texts = split_names(self.turns)
        if unknown := [text for text in texts if text not in QUARTER_TURNS]:
            raise UserError(f"--turns: {unknown[0]!r} is not 0, 90, 180 or 270")
        return [QUARTER_TURNS.index(text) for text in dict.fromkeys(texts)]

    def chosen_scales(self) -> list[float]:
        """The scales.

        Raises:
          UserError: a scale is not a number from 1/16 to 16.
        """
        scales = []
        for text in dict.fromkeys(split_names(self.scales)):
            try:
                scale = float(text)
            except ValueError:
                scale = 0.0
            if not 1 / 16 <= scale <= 16:
                raise UserError(f"--scales: {text!r} is not a number from 0.0625 to 16")
            scales.append(scale)
        return scales


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConfidenceOptions(PairOptions):
    """Options of `bench confidence`.

    Attributes:
      root: Folder of sets with poses: SET/images with K.txt, and SET/gt_dense_cameras.
      methods: Presets to compare, separated by commas or blanks.
      pairs: How many pairs are drawn.
      diagram: Write the reliability diagram to this PNG file.
      seeds: How often each method is run, with seeds 0, 1, ...
    """

    root: Path
    methods: tuple[str, ...] = ("default",)
    pairs: int = 200
    diagram: Path | None = None
    seeds: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pairs < 1:
            raise UserError(f"--pairs must be at least 1; got {self.pairs}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecallOptions(BenchOptions):
    """Options of `bench recall`.

    Attributes:
      root: Folder of the photos.
      strangers: Folder of photos of other places. Their pairs are not true.
      truth: Folder of a COLMAP model of the photos, or of poses of 7-Scenes with K.txt.
      depth: By poses alone, the distance at which the common part of two photos is measured, in
        units of the poses.
      every: Each so many photos is used.
      methods: How a photo is described, separated by commas or blanks: vlad, gem.
      nearest: Numbers of similar photos to look at, separated by commas or blanks.
    """

    root: Path
    strangers: Path | None = None
    truth: Path
    depth: float = 2.0
    every: int = 1
    methods: tuple[str, ...] = ("vlad,gem",)
    nearest: tuple[str, ...] = ("5,10,20,50",)

    def __post_init__(self) -> None:
        whole_numbers(self.nearest, "--nearest")
        if self.every < 1:
            raise UserError(f"--every must be at least 1; got {self.every}")
        if not self.depth > 0:
            raise UserError(f"--depth must be more than 0; got {self.depth}")
