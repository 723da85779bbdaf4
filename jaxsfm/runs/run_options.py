"""The options of runs as Python callers give them, and the checks that come before the work."""

import dataclasses
from pathlib import Path

from jaxsfm.colmap.intrinsics import MODELS
from jaxsfm.errors import UserError
from jaxsfm.matching.engines import chosen_engine
from jaxsfm.matching.execution import Execution
from jaxsfm.options import (
    LOCAL,
    USUAL_WEIGHTS,
    EngineChoice,
    NewPhotosChoice,
    ReconstructionChoice,
    Step,
    WeightsChoice,
    check_seed,
    check_threads,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Computation:
    """With what features and matches are computed."""

    network: WeightsChoice = USUAL_WEIGHTS
    """The files of the network's parameters; `localize` and `extend` need those of the run."""
    execution: Execution = dataclasses.field(default_factory=Execution)
    """Devices, batches and memory."""
    engine: EngineChoice = LOCAL
    """This process, or workers on Ray."""
    progress: bool = False
    """Whether progress bars are shown on standard error."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions(Computation, ReconstructionChoice):
    """What a reconstruction does, beyond its `Config`."""

    without: tuple[Step, ...] = ()
    """Steps that are left out. For measurements: each step is there because it is worth something.
    """


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocalizeOptions(Computation, NewPhotosChoice):
    """What `localize` and `extend` do, beyond what the finished run fixes."""

    reference: Path | None = None
    """Reference poses of the new photos and of the run's photos."""


def check_options(options: RunOptions) -> None:
    """Raise UserError, before the work, for options that COLMAP or the engine would refuse."""
    if options.best_pairs is not None and options.best_pairs < 1:
        raise UserError(f"--best-pairs must be at least 1; got {options.best_pairs}")
    if options.camera_model not in MODELS:
        raise UserError(
            f"--camera-model must be one of {', '.join(MODELS)}; got {options.camera_model!r}"
        )
    if options.intrinsics is not None and options.cameras in ("folder", "photo"):
        raise UserError(
            f"--cameras {options.cameras} and --intrinsics exclude each other, because a known "
            "camera is that of all photos, and a list says the camera of each"
        )
    if options.positions_inside and options.georeference == "off":
        raise UserError("--positions-inside and --georeference off exclude each other")
    check_seed(options.seed)
    check_threads(options.threads)
    chosen_engine(options.engine)
