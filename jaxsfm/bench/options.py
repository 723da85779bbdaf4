"""The options of the benchmarks' commands, each declared once; `jaxsfm.cli` reads them.

Nothing heavy is imported here, so that `jaxsfm bench NAME --help` is quick.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

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
      partners: Numbers of partners of each photo, separated by commas or blanks.
      candidates: For each partner, so many of the most similar photos are candidates. With 1, the
        most similar photos are the partners. Numbers separated by commas or blanks.
    """

    root: Path
    strangers: Path | None = None
    truth: Path
    depth: float = 2.0
    every: int = 1
    methods: tuple[str, ...] = ("vlad,gem",)
    partners: tuple[str, ...] = ("5,10,20,50",)
    candidates: tuple[str, ...] = ("5",)

    def __post_init__(self) -> None:
        whole_numbers(self.partners, "--partners")
        whole_numbers(self.candidates, "--candidates")
        if self.every < 1:
            raise UserError(f"--every must be at least 1; got {self.every}")
        if not self.depth > 0:
            raise UserError(f"--depth must be more than 0; got {self.depth}")
