"""Options that several commands share: the files of weights, and the engine that computes."""

import dataclasses
from pathlib import Path
from typing import Literal


@dataclasses.dataclass(frozen=True, kw_only=True)
class WeightsChoice:
    """The files from which the parameters are read."""

    weights: Path | None = None
    """File with the network's weights (jaxsfm weights convert); default: torchvision's."""
    relocalizer: Path | None = None
    """File with learned scores for keypoints (jaxsfm train relocalizer); default: jaxsfm's own."""


USUAL_WEIGHTS = WeightsChoice()
"""The weights and the relocalizer that are installed with jaxsfm."""


EngineName = Literal["local", "ray"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EngineChoice:
    """Which processes compute features and matches."""

    engine: EngineName = "local"
    """Compute in this process (local), or by workers on a Ray cluster (ray)."""
    workers: int | None = None
    """Number of workers on Ray; default: one for each GPU, without GPUs one for each machine."""
    ray_address: str | None = None
    """Address HOST:PORT of a Ray cluster, or local for a new one.
    The default is RAY_ADDRESS, else the cluster on this machine, else a new one for this run."""


LOCAL = EngineChoice()
"""Everything is computed in this process."""
