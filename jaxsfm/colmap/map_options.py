"""The settings of a mapping, and what they are in COLMAP's own options."""

import dataclasses
import math
import statistics
from collections.abc import Iterable

import pycolmap

from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.options import Mapper

DRAFT_GROWTH = 1.4
"""A draft is adjusted as a whole when it has grown by this factor; COLMAP's own is 1.1. On *statue*
a run takes 138 s instead of 240."""

DRAFT_REFINEMENTS, DRAFT_TOLERANCE = 2, 1e-4
"""An adjustment of the whole draft filters observations and adjusts again at most so often
(COLMAP's own: 5). It ends when a step lowers the cost by less than this share (COLMAP's own: 0, so
that each takes 50 steps). All points and all poses are adjusted afterwards. 500 frames of *kitchen*
take 147 s instead of 391, and the cameras of the draft are 0.073 m off instead of 0.071
(docs/decisions/view-graph.md)."""

LEAST_PARALLAX = 27.0
"""A draft has only points whose directions from two images differ by so many working pixels.
COLMAP's own limit of 1.5 deg is 31 pixels in a photo with a focal length of 1200, and its keypoints
are three times as exact as ours. In frames of 480 pixels, 1.5 deg are 10 pixels. Of points with so
little parallax, those that noise moved nearer are kept, and those that it moved away are not: all
frames of *kitchen* shrank to a four-thousandth within 40 frames
(docs/decisions/repeated-structure.md)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Settings of the mapper."""

    mapper: Mapper = "incremental"
    refine_intrinsics: bool = True
    seed: int = 0
    threads: int = -1
    """Threads of verification and bundle adjustment; -1 takes all cores. With one thread the model
    is repeatable to the last byte."""
    scale: float = 1.0
    """Original pixels per working pixel. COLMAP's pixel thresholds are multiplied by it."""
    held: tuple[int, ...] = ()
    """Ids of cameras whose place on their rig is known, and stays."""
    draft: bool = False
    """The models are refined afterwards, so the first run of the incremental mapper makes a draft.
    It adjusts the whole model less often and less exactly, and leaves out images that see too few
    of its points. COLMAP would register these by single pairs (its structure-less fallback), filter
    them out after the next adjustment, and try again, which takes more than a quarter of the time
    on *statue*."""

    def verification(self, *, relative_poses: bool = True) -> VerificationOptions:
        """The settings of the two-view verification before this mapping."""
        return VerificationOptions(
            seed=self.seed,
            threads=self.threads,
            scale=self.scale,
            relative_poses=relative_poses,
        )


def incremental_options(options: MapOptions) -> pycolmap.IncrementalPipelineOptions:
    """The options as the incremental mapper takes them."""
    p = pycolmap.IncrementalPipelineOptions()
    p.ba_refine_focal_length = p.ba_refine_extra_params = options.refine_intrinsics
    p.ba_refine_principal_point = p.ba_refine_sensor_from_rig = False
    p.num_threads = p.mapper.num_threads = options.threads
    p.random_seed = p.mapper.random_seed = options.seed
    p.min_model_size = 2
    if options.draft:
        p.structure_less_registration_fallback = False
        p.ba_global_frames_ratio = p.ba_global_points_ratio = DRAFT_GROWTH
        p.ba_global_max_refinements = DRAFT_REFINEMENTS
        p.ba_global_function_tolerance = DRAFT_TOLERANCE
    p.extract_colors = False  # `colour_points` does it, with our own reader
    p.mapper.init_max_error *= options.scale
    p.mapper.abs_pose_max_error *= options.scale
    p.mapper.filter_max_reproj_error *= options.scale
    p.triangulation.complete_max_reproj_error *= options.scale
    p.triangulation.merge_max_reproj_error *= options.scale
    return p


def narrowest_angle_deg(cameras: Iterable[pycolmap.Camera], scale: float) -> float:
    """The least angle between two rays of a point of a draft: see `LEAST_PARALLAX`.

    It is never less than COLMAP's own limit.

    Args:
      cameras: of all images.
      scale: original pixels per working pixel.
    """
    focal = statistics.median(camera.mean_focal_length() for camera in cameras)
    own = pycolmap.IncrementalTriangulatorOptions().min_angle
    return max(own, math.degrees(math.atan(LEAST_PARALLAX * scale / focal)))


def global_options(options: MapOptions) -> pycolmap.GlobalPipelineOptions:
    """The options as the global mapper takes them."""
    p = pycolmap.GlobalPipelineOptions()
    p.num_threads = options.threads
    p.random_seed = options.seed
    p.mapper.num_threads = options.threads
    p.mapper.random_seed = options.seed
    ba = p.mapper.bundle_adjustment
    ba.refine_focal_length = ba.refine_extra_params = options.refine_intrinsics
    ba.refine_principal_point = False
    return p
