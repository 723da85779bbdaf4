"""What a run does beyond matching, and what it refuses before the work."""

import dataclasses
from pathlib import Path
from typing import Literal

from jaxsfm.colmap.mapper import Mapper
from jaxsfm.errors import UserError
from jaxsfm.io.pair_selection import Retrieval
from jaxsfm.matching.engines import chosen_engine
from jaxsfm.matching.execution import Execution
from jaxsfm.options import LOCAL, USUAL_WEIGHTS, EngineChoice, WeightsChoice


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What to do, beyond the matching `Config`."""

    pairs: str = "exhaustive"
    """`exhaustive`, a file with two image names a line, `sequential:K`, `retrieval:K`, or several
    joined by `+` (`jaxsfm.io.pair_selection`)."""
    retrieval: Retrieval = "vlad"
    """How photos are described for `retrieval:K`."""
    best_pairs: int | None = None
    """Hand on only each image's N pairs with the most inliers (a union); None: all."""
    intrinsics: str | None = None
    """K.txt or MODEL:p1,p2,..; None: one camera per photo."""
    refine_intrinsics: Literal["auto", "yes", "no"] = "auto"
    """`auto` refines them unless they are given."""
    mapper: Mapper = "incremental"
    seed: int = 0
    threads: int = -1
    network: WeightsChoice = USUAL_WEIGHTS
    """The files of its parameters."""
    reference: Path | None = None
    """Reference poses to evaluate the model against."""
    with_database: Path | None = None
    """A COLMAP database of the same photos, whose matches are mapped beside ours."""
    with_hloc: tuple[Path, Path] | None = None
    """hloc's features and matches, likewise."""
    execution: Execution = dataclasses.field(default_factory=Execution)
    """Devices, batches, memory."""
    engine: EngineChoice = LOCAL
    """This process, or workers on Ray."""
    keep_features: bool = False
    """Leave them in the folder, for `localize` and `extend` (25 MB for 1536 x 1024)."""
    progress: bool = False
    """Progress bars on standard error."""

    @property
    def refines(self) -> bool:
        """Whether mapping refines intrinsics."""
        if self.refine_intrinsics == "auto":
            return self.intrinsics is None
        return self.refine_intrinsics == "yes"


def check_options(options: RunOptions) -> None:
    """Raises UserError for what COLMAP or the engine would not take, before the work."""
    if options.best_pairs is not None and options.best_pairs < 1:
        raise UserError(f"--best-pairs must be at least 1; got {options.best_pairs}")
    check_seed(options.seed)
    check_threads(options.threads)
    chosen_engine(options.engine)


def check_seed(seed: int) -> None:
    """Raises UserError unless COLMAP takes it."""
    if not 0 <= seed < 2**31:
        raise UserError(f"--seed must lie in 0 .. 2147483647; got {seed}")


def check_threads(threads: int) -> None:
    """Raises UserError unless COLMAP takes it."""
    if threads == 0 or threads < -1:
        raise UserError(f"--threads must be positive, or -1 for all; got {threads}")
