"""Where images and pairs are computed: in this process, or by workers on Ray."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Protocol

from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.features import FeatureCapacity, ImageFeatures
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.weights import Weights
from jaxsfm.matching import extraction, pair_matching
from jaxsfm.matching.execution import Execution
from jaxsfm.options import EngineChoice


class Engine(Protocol):
    """Two stages. Results come in any order, and never depend on the engine."""

    def extracted(
        self,
        weights: Weights,
        images: Iterable[ImageFile],
        *,
        config: Config,
        execution: Execution | None = None,
    ) -> Iterator[tuple[ImageFile, ImageFeatures | ImageError]]:
        """As `jaxsfm.matching.extraction.extracted`."""
        ...

    def matched(
        self,
        load: Callable[[str], ImageFeatures],
        capacities: Mapping[str, FeatureCapacity],
        pairs: Iterable[tuple[str, str]],
        *,
        config: Config,
        seed: int = 0,
        execution: Execution | None = None,
    ) -> Iterator[PairResult]:
        """As `jaxsfm.matching.pair_matching.matched`."""
        ...


class LocalEngine:
    """All devices of this process."""

    extracted = staticmethod(extraction.extracted)
    matched = staticmethod(pair_matching.matched)


def chosen_engine(choice: EngineChoice) -> Engine:
    """The engine of a command's --engine, --workers and --ray-address.

    Raises:
      UserError: an option that the engine does not have, or Ray is not installed.
    """
    if choice.workers is not None and choice.workers < 1:
        raise UserError(f"--workers must be at least 1; got {choice.workers}")
    if choice.engine == "local":
        if choice.workers is not None or choice.ray_address is not None:
            given = "--ray-address" if choice.workers is None else "--workers"
            raise UserError(f"{given} is for --engine ray")
        return LocalEngine()
    from jaxsfm.matching.ray.cluster import imported_ray
    from jaxsfm.matching.ray.engine import RayEngine

    imported_ray()  # before the work
    return RayEngine(address=choice.ray_address, workers=choice.workers)
