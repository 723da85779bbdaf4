"""Engines extract features and match pairs: in this process, or with workers on Ray."""

from typing import TypeAlias

from jaxsfm.errors import UserError
from jaxsfm.matching import extraction, pair_matching
from jaxsfm.matching.ray.cluster import import_ray
from jaxsfm.matching.ray.engine import RayEngine
from jaxsfm.options import EngineChoice


class LocalEngine:
    """This process computes, with all of its devices."""

    starts_workers = False
    """Whether every call starts workers first, which takes seconds: then few calls with many items
    are better than many calls."""
    extract_images = staticmethod(extraction.extract_images)
    match_pairs = staticmethod(pair_matching.match_pairs)


Engine: TypeAlias = LocalEngine | RayEngine
"""Extracts and matches. Results come in any order, and never depend on the engine."""


def chosen_engine(choice: EngineChoice) -> Engine:
    """The engine that --engine, --workers and --ray-address choose; UserError if they cannot."""
    if choice.workers is not None and choice.workers < 1:
        raise UserError(f"--workers must be at least 1; got {choice.workers}")
    if choice.engine == "local":
        if choice.workers is not None or choice.ray_address is not None:
            given = "--ray-address" if choice.workers is None else "--workers"
            raise UserError(f"{given} is for --engine ray")
        return LocalEngine()
    import_ray()  # a missing package is reported before the work
    return RayEngine(address=choice.ray_address, workers=choice.workers)
