"""Options that commands and Python callers share: each is declared here once.

The command line reads these classes directly, so a field's description is also its `--help`. They
import nothing heavy, which keeps `--help` quick. A class whose name ends in `Choice` is not checked
when it is made; who uses it checks it and names the option in the error.
"""

import dataclasses
from pathlib import Path
from typing import Literal

from jaxsfm.errors import UserError

EngineName = Literal["local", "ray"]
Mapper = Literal["incremental", "global"]
"""COLMAP's mappers."""
Step = Literal["upright", "remap", "split", "pose-ambiguity", "refine", "register"]
"""The steps of a run that can be left out, to see what they are worth (`jaxsfm.sfm.road`).

upright: photos that are stored sideways are turned. remap: the second mapping. split: models in
which photos contradict each other are split. pose-ambiguity: photos are looked for in other places.
refine: the models are refined; without it they have points of a share of the matches, and no photos
are registered. register: photos without a place are registered in the refined models.
"""
CameraSharing = Literal["auto", "single", "folder", "photo"]
"""Which photos share one camera (`jaxsfm.colmap.cameras`)."""
PanoramaChoice = Literal["auto", "yes", "no"]
"""Which photos are 360-degree photos."""
Retrieval = Literal["gem", "vlad", "netvlad"]
"""How a photo is described as a whole (`jaxsfm.core.retrieval`)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WeightsChoice:
    """Which files the network's parameters are read from.

    Attributes:
      weights: File with the network's parameters, made by jaxsfm weights convert. Without it, the
        parameters of torchvision are used, which are downloaded once.
      relocalizer: File with a relocalizer, made by jaxsfm train relocalizer; its learned
        scores choose the keypoints. Without it, learned keypoints use the relocalizer that comes
        with jaxsfm.
    """

    weights: Path | None = None
    relocalizer: Path | None = None


USUAL_WEIGHTS = WeightsChoice()
"""The parameters that jaxsfm finds or downloads by itself."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EngineChoice:
    """Which processes extract features and match pairs.

    Attributes:
      engine: local: this process. ray: workers on a Ray cluster.
      workers: Number of workers on Ray. Without it, there is one for each GPU of the cluster, or
        one for each machine if there are no GPUs.
      ray_address: HOST:PORT of a Ray cluster, or local for a new cluster that ends with the
        command. Without it, the cluster is the one that the variable RAY_ADDRESS names, else the
        one that runs on this machine, else a new one.
    """

    engine: EngineName = "local"
    workers: int | None = None
    ray_address: str | None = None


LOCAL = EngineChoice()
"""This process computes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExecutionChoice:
    """How many devices are used, how large batches are, and how much memory features may take.

    Results do not depend on these options, except for rounding. None means that jaxsfm chooses the
    value from the machine, the images' sizes and their number.

    Attributes:
      devices: How many of JAX's devices are used. Without it, all are used.
      images_at_once: How many images each device works on at once. Without it, as many as fit into
        memory, and one on a CPU.
      pairs_at_once: How many pairs each device matches at once. Without it, as many as fit into
        memory, and one on a CPU.
      memory_gb: Gigabytes on each device for the features of images that wait for their next pair.
        With less memory, images are loaded more often. Without it, half of an accelerator's memory,
        or an eighth of the machine's memory on a CPU but at most 1.6.
    """

    devices: int | None = None
    images_at_once: int | None = None
    pairs_at_once: int | None = None
    memory_gb: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReconstructionChoice:
    """Which pairs are tried, and how the model is made from their matches.

    Attributes:
      pairs: Which pairs are tried. exhaustive: all pairs. FILE: a file with two image names on each
        line. retrieval:K: each photo with K photos that are similar to it, and differ from each
        other. sequential:K: each photo with the next K photos by name. Join several of these with
        +. auto: exhaustive for up to 40 photos, and retrieval:20+sequential:3 for more.
      retrieval: How a photo is described by one vector for retrieval:K. netvlad needs NetVLAD's
        weights, given with --weights.
      best_pairs: Map only the N pairs of each image that have the most inliers.
      intrinsics: The known camera of all photos, or of each. FILE: a text file with a 3 x 3 matrix,
        in which the centre of the top-left pixel is (0, 0), or with a line NAME MODEL WIDTH HEIGHT
        p1 p2 .. for each photo. MODEL:p1,p2,..: a COLMAP camera model with its parameters, in
        COLMAP's pixels, in which that centre is (0.5, 0.5). Without it, cameras are estimated.
      rig: COLMAP's rig_config.json: which cameras are mounted together, and where, in metres. Those
        photos were taken together whose names are the same after the prefix of their camera. Places
        that the file does not say are estimated (docs/guide/rigs.md).
      masks: Folder with masks, images of the size of the photos, or one mask for all photos. Black
        pixels are not used. In a folder, the mask of sub/a.jpg is sub/a.jpg.png.
      panorama: Which photos are 360-degree photos (equirectangular, twice as wide as high). auto:
        those that say so in XMP (GPano), or whose EXIF names a 360-degree camera. yes: all. no:
        none. Each is turned into pinhole views of one centre.
      nadir: So many degrees around straight down are not used of 360-degree photos, because the
        photographer stands there. Their views end 45 degrees below the horizon.
      cameras: Which photos share a camera. single: all photos. folder: the photos of each
        sub-folder. photo: none. auto: those whose EXIF names the same camera, lens and focal
        length; photos of one size without any EXIF share one camera, too.
      camera_model: COLMAP camera model of cameras that are not known, for example OPENCV or
        SIMPLE_RADIAL_FISHEYE.
      refine_intrinsics: Whether mapping refines the intrinsics. auto: only if --intrinsics is not
        given.
      mapper: Which of COLMAP's mappers computes the model. incremental: the one that adds photo
        after photo. global: the one that places all photos at once.
      seed: Seed of all random choices.
      threads: Number of threads of COLMAP, JAX and all else; -1 uses all cores. With 1 thread, the
        same command gives the same model, byte for byte.
      reference: Folder with reference poses that the model is compared with: Strecha .camera files,
        7-Scenes .pose.txt files, LLFF's poses_bounds.npy, or a COLMAP model.
      georeference: What the model is moved onto, so that it is in metres (east, north, up). gps:
        the GPS positions in the photos. FILE: a table of camera positions or of ground control
        points (docs/guide/georeference.md). off: nothing. auto: gps, if at least three photos of
        the model have a position, and these positions determine the move well.
      positions_inside: Positions of cameras also take part in a last adjustment, which unbends long
        rows of photos. It is dropped if positions that are left out fit no better then. Without
        this option, the model is only moved as a whole.
      with_database: COLMAP database of the same photos, made by another tool. Its matches are
        mapped together with those of jaxsfm.
      with_hloc: The features.h5 and matches.h5 that hloc wrote for the same photos. Its matches
        are mapped together with those of jaxsfm.
      with_dense: File of a detector-free matcher (LoFTR, RoMa, DKM) with keypoints0 and keypoints1
        of each pair, as hloc stores it. Its points are gathered to keypoints that pairs share, and
        its matches are mapped together with those of jaxsfm.
      keep_features: Keep the features in the folder (25 MB for a photo of 1536 x 1024), so that
        localize and extend need not compute them again. They use features of full size, so this
        helps them with --low-resolution 0.
    """

    pairs: str = "auto"
    retrieval: Retrieval = "vlad"
    best_pairs: int | None = None
    intrinsics: str | None = None
    rig: Path | None = None
    masks: Path | None = None
    panorama: PanoramaChoice = "auto"
    nadir: float = 0.0
    cameras: CameraSharing = "auto"
    camera_model: str = "SIMPLE_RADIAL"
    refine_intrinsics: Literal["auto", "yes", "no"] = "auto"
    mapper: Mapper = "incremental"
    seed: int = 0
    threads: int = -1
    reference: Path | None = None
    georeference: str = "auto"
    positions_inside: bool = False
    with_database: Path | None = None
    with_hloc: tuple[Path, Path] | None = None
    with_dense: Path | None = None
    keep_features: bool = False

    @property
    def refines(self) -> bool:
        """Whether mapping refines intrinsics."""
        if self.refine_intrinsics == "auto":
            return self.intrinsics is None
        return self.refine_intrinsics == "yes"


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewPhotosChoice:
    """How new photos find their place in the models of a finished run.

    Attributes:
      images: Folder with the run's photos; for extend, also with the new ones. Without it, the
        folder in which the run found them.
      intrinsics: Intrinsics of the new photos, written as for reconstruct. Without it, a photo gets
        a camera of the run if the run has exactly one camera of this size that several photos
        share. Otherwise it gets its own camera, whose focal length is estimated.
      shortlist: With how many photos a new photo is matched. The most similar ones are taken.
      keep_features: Keep the features of the run's photos in its folder (25 MB for a photo of
        1536 x 1024), so that the next call need not compute them again.
      threads: Number of threads of COLMAP, JAX and all else; -1 uses all cores.
    """

    images: Path | None = None
    intrinsics: str | None = None
    shortlist: int = 20
    keep_features: bool = False
    threads: int = -1


def check_seed(seed: int) -> None:
    """Raise UserError for a seed that COLMAP does not take."""
    if not 0 <= seed < 2**31:
        raise UserError(f"--seed must lie in 0 .. 2147483647; got {seed}")


def check_threads(threads: int) -> None:
    """Raise UserError for a number of threads that COLMAP does not take."""
    if threads == 0 or threads < -1:
        raise UserError(f"--threads must be positive, or -1 for all; got {threads}")
