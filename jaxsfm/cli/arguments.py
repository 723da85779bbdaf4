"""Arguments of commands in the form that tyro expects, and the options that choose a `Config`: a
preset, and single settings that differ from it."""

import contextlib
import dataclasses
import functools
import inspect
import operator
import os
import re
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxsfm.config import BackboneName, Config, Convolutions, Keypoints, Refinement, preset
from jaxsfm.core.pair_shape import Products
from jaxsfm.errors import UserError
from jaxsfm.io.entries import named_place

Command = Callable[..., int]
_WRAPPED = re.compile(r"\n {4,}(?=[^\s$])")
"""Where an argument's description goes on in the next line; lines of examples start with $."""
Preset = Literal["paper", "default", "robust"]
Positional = tyro.conf.Positional


def unwrapped(command: Command) -> Command:
    """Join the lines of every argument's description, also in the option classes of the command.

    tyro wraps descriptions itself, but keeps some of the line ends that it finds.
    """
    documented: list[Callable[..., object]] = [command]
    for kind in typing.get_type_hints(command).values():
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            documented += kind.__mro__[:-1]
    for each in documented:
        each.__doc__ = _WRAPPED.sub(" ", inspect.cleandoc(each.__doc__ or ""))
    return command


@contextlib.contextmanager
def named_options() -> Iterator[None]:
    """Make a ValueError about a field, which its message starts with, a UserError about the option
    that sets the field."""
    try:
        yield
    except ValueError as error:
        field, _, problem = str(error).partition(" ")
        option = field.rpartition(".")[2].replace("_", "-")
        raise UserError(f"--{option} {problem}") from error


def one_of(commands: Mapping[str, Command]) -> object:
    """The type of a command's argument that is the result of one of several commands."""
    return functools.reduce(
        operator.or_,
        (
            Annotated[object, tyro.conf.subcommand(name, constructor=unwrapped(command))]
            for name, command in commands.items()
        ),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatchingChoice:
    """What is computed for an image and for a pair.

    Attributes:
      preset: A named set of parameters. paper: the constants of the authors' code. default: adds
        octaves, centred descriptors and neighbourhood consensus (for night, seasons and weather),
        better planes, a view graph and two passes of refinement. robust: as default, but photos
        smaller than --max-size are enlarged, at most twice.
      max_size: Limit for the longer side of a photo, in pixels. Larger photos are reduced to it.
      keypoints: How a keypoint is placed in its cell of 8 x 8 pixels. relocalized: at the largest
        norm of the features, which is the paper's rule. learned: at the largest learned score.
        grid: in the centre of the cell, for comparisons. preset: as the preset says.
      backbone: The network: vgg16, which the paper uses; alexnet; or vgg19, which needs --weights.
      convolutions: Number format in which the network multiplies. bfloat16 is meant for
        accelerators.
      products: Number format of the descriptors whose products find the matches. float16 and
        bfloat16 are meant for accelerators.
    """

    preset: Preset = "default"
    max_size: int = 1600
    keypoints: Keypoints | Literal["preset"] = "preset"
    backbone: BackboneName = "vgg16"
    convolutions: Convolutions = "float32"
    products: Products = "float32"

    def config(self, relocalizer: Path | None = None) -> Config:
        """The preset with the settings that differ from it.

        Args:
          relocalizer: file of learned scores; if there is one, keypoints are learned.

        Raises:
          UserError: a setting that cannot be, or settings that contradict each other.
        """
        with named_options():
            return self._config(relocalizer)

    def _config(self, relocalizer: Path | None) -> Config:
        config = dataclasses.replace(
            preset(self.preset),
            max_size=self.max_size,
            convolutions=self.convolutions,
            products=self.products,
            backbone=self.backbone,
        )
        keypoints = self.keypoints
        if relocalizer is not None:
            if keypoints not in ("preset", "learned"):
                raise ValueError(
                    f"relocalizer {relocalizer} needs learned keypoints; got {keypoints}"
                )
            keypoints = "learned"
        if keypoints != "preset":
            config = dataclasses.replace(config, keypoints=keypoints)
        return config


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelChoice(MatchingChoice):
    """What is computed for an image, for a pair and for the model.

    Attributes:
      view_graph: Whether the view graph drops pairs whose rotations contradict those of stronger
        pairs. It is for scenes that repeat themselves. preset: as the preset says.
      refine: Number of passes of the refinement, which moves keypoints to a fraction of a pixel. 0
        switches it off. Without it, as many as the preset says.
      low_resolution: Longer side, in pixels, at which photos are described and matched. Photos that
        find no place in this way are matched at --max-size, and so are all photos if there is no
        model. 0, or --refine 0, describes all photos at --max-size. Without it, as the preset says:
        default takes 800, and five eighths of the median photo if that has less than 1000 pixels.
    """

    view_graph: Literal["preset", "yes", "no"] = "preset"
    refine: int | None = None
    low_resolution: int | None = None

    def _config(self, relocalizer: Path | None) -> Config:
        config = super()._config(relocalizer)
        if self.view_graph != "preset":
            config = dataclasses.replace(config, view_graph=self.view_graph == "yes")
        if self.refine is not None:
            if self.refine < 0:
                raise ValueError(f"refine must be at least 0; got {self.refine}")
            passes = Refinement(passes=self.refine) if self.refine else None
            config = dataclasses.replace(config, refinement=passes)
        if self.low_resolution is not None:
            asked = self.low_resolution or None
            config = dataclasses.replace(config, low_resolution=asked, low_resolution_share=1.0)
        return config


def check_writable(path: Path | None, option: str, suffixes: tuple[str, ...]) -> None:
    """Check that a file can be written, before the work is done and not after it. None passes.

    Raises:
      UserError: the name ends in none of the suffixes, or the place cannot be written to. The
        message starts with the option. Or a link in a work folder leads there (`named_place`).
    """
    if path is None:
        return
    named_place(path)
    if path.suffix.lower() not in suffixes:
        raise UserError(f"{option} {path}: the name must end in {' or '.join(suffixes)}")
    try:
        writable = not path.is_dir() and path.parent.is_dir() and os.access(path.parent, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        raise UserError(f"{option} {path}: cannot be written there")
