"""What the options of several benchmarks have in common, and those of `bench wxbs`.

Nothing heavy is imported here, so that `jaxsfm bench NAME --help` is quick.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from jaxsfm.config import MIN_SIDE
from jaxsfm.errors import UserError
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice


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
class WxbsOptions(SetOptions, NetworkOptions, SeedOptions):
    """Options of `bench wxbs`.

    Attributes:
      root: Folder of the categories: CATEGORY/NAME/{01,02}.png and corrs.txt.
      sets: CATEGORY or CATEGORY/NAME, separated by commas or blanks. Without it, all pairs.
      methods: Methods to compare, separated by commas or blanks. rootsift: COLMAP's own features.
        paper, default, robust: the presets. paper-learned: the preset paper with keypoints at the
        largest learned scores. paper-naive, paper-k4, paper-conv4, paper-pool5: as in bench
        strecha. grid, reloc, learned: the preset default without alignment; keypoints are at the
        centres of cells (grid), at the largest norms (reloc) or at the largest learned scores
        (learned). default-products-float16, default-products-bfloat16: the preset default with
        descriptors of this type.
      max_size: Limit for the longer side of a photo, in pixels. Without it, that of the preset.
      protocol: How matches are judged. ours: the best of five fundamental matrices, limits of 1 to
        20 px. lo: as published for other methods, with one run of MAGSAC++ (0.25 px, 100,000
        iterations) and limits of 0 to 10 px.
    """

    root: Path
    sets: tuple[str, ...] | None = None
    methods: tuple[str, ...] = ("rootsift,paper,default,robust",)
    max_size: int | None = None
    protocol: Literal["ours", "lo"] = "ours"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_size is not None:
            check_side(self.max_size, "--max-size")
