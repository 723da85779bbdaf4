"""Engines extract features and match pairs: in this process, or with workers on Ray."""

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
    """Extracts and matches. Results come in any order, and never depend on the engine."""

    @property
    def starts_workers(self) -> bool:
        """Whether every call starts workers first, which takes seconds: then few calls with many
        items are better than many calls."""
        ...

    def extract_images(
        self,
        weights: Weights,
        images: Iterable[ImageFile],
        *,
        config: Config,
        execution: Execution | None = None,
    ) -> Iterator[tuple[ImageFile, ImageFeatures | ImageError]]:
        """See `jaxsfm.matching.extraction.extract_images`."""
        ...

    def match_pairs(
        self,
        load: Callable[[str], ImageFeatures],
        capacities: Mapping[str, FeatureCapacity],
        pairs: Iterable[tuple[str, str]],
        *,
        config: Config,
        seed: int = 0,
        execution: Execution | None = None,
    ) -> Iterator[PairResult]:
        """See `jaxsfm.matching.pair_matching.match_pairs`."""
        ...


class LocalEngine:
    """This process computes, with all of its devices."""

    starts_workers = False
    extract_images = staticmethod(extraction.extract_images)
    match_pairs = staticmethod(pair_matching.match_pairs)


def chosen_engine(choice: EngineChoice) -> Engine:
    """The engine that --engine, --workers and --ray-address choose.

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
    from jaxsfm.matching.ray.cluster import import_ray
    from jaxsfm.matching.ray.engine import RayEngine

    import_ray()  # a missing package is reported before the work
    return RayEngine(address=choice.ray_address, workers=choice.workers)
