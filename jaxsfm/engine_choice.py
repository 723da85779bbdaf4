"""Which engine computes, as the command line hands it on."""

import dataclasses
from typing import Literal

EngineName = Literal["local", "ray"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EngineChoice:
    """Who computes."""

    engine: EngineName = "local"
    """local: this process; ray: workers on a Ray cluster."""
    workers: int | None = None
    """On Ray; default: one for each GPU of the cluster, without GPUs one for each machine."""
    ray_address: str | None = None
    """HOST:PORT of a Ray cluster; default: RAY_ADDRESS, else the one that runs here, else a new
    one for this run (local: always)."""


LOCAL = EngineChoice()
"""This process."""
