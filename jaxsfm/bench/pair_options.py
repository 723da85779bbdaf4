"""The options of the benchmarks of pairs of photos."""

import dataclasses
from pathlib import Path
from typing import Literal

from jaxsfm.bench.options import NetworkOptions, SeedOptions, SetOptions, check_side, split_names
from jaxsfm.errors import UserError

QUARTER_TURNS = ("0", "90", "180", "270")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairOptions(NetworkOptions, SeedOptions):
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
class WxbsOptions(PairOptions, SetOptions):
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
class HomographyOptions(PairOptions, SetOptions):
    """Options of `bench homography`.

    Attributes:
      root: Folder of the sequences. A sequence has SEQUENCE/img1.png and H1to2p (or .xml), or
        SEQUENCE/1.ppm and H_1_2.
    """

    root: Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class TurnsOptions(PairOptions, SetOptions):
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
class ConfidenceOptions(PairOptions, SetOptions):
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
class PosesOptions(PairOptions):
    """Options of `bench poses`.

    Attributes:
      root: Folder of the photos.
      pairs: File with a row for each pair: two names in the folder, K of both photos, and the pose
        of the second one, as SuperGlue's scannet_test_pairs_with_gt.txt and glue-factory's
        pairs_calibrated.txt have them.
      every: Each so many pairs is used.
      seeds: How often each method is run, with seeds 0, 1, ...
    """

    root: Path
    pairs: Path
    every: int = 1
    seeds: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.every < 1:
            raise UserError(f"--every must be at least 1; got {self.every}")
