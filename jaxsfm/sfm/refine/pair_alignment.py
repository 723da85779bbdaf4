"""Matches to a fraction of a pixel.

The patch around the first keypoint of a match is warped by the match's homography, and the second
keypoint moves to where the patch agrees with the second image. This is done from the coarsest size
to the finest, because relocalized keypoints are off by a few pixels, and a patch finds its place
from about four. Where nothing agrees (another season, a reflection) a keypoint stays where it was.
"""

from typing import NamedTuple

import numpy as np

from jaxsfm.config import Config, Refinement
from jaxsfm.core.align import square_patch
from jaxsfm.io.images import ImageFile, read_image
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.photos import Pixels, intensities
from jaxsfm.sfm.refine.device_images import block_means, chunks, padded
from jaxsfm.sfm.refine.patch_alignment import (
    AlignmentLimits,
    align_patches,
    make_templates,
    to_host,
)

DEFAULTS = Refinement()
"""The radius of patches, the iterations and the limits are those of the refinement. In unlike light
and seasons, a lower score (0.6) lets in patches that only look alike
(docs/decisions/refinement.md)."""


class AlignedMatches(NamedTuple):
    """Matches moved to sub-pixel accuracy."""

    keypoints1: np.ndarray
    """float64 (n, 2): original pixels of the second image."""
    aligned: np.ndarray
    """bool (n,): which keypoints were moved; the others stay where they were."""


def local_map(h: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Map points (n, 2) by homographies (n, 3, 3), and small offsets around them.

    Source: Hartley and Zisserman, 2nd ed., section 2.2 (the affinity that agrees to first order).

    Returns:
      (n, 2) points; (n, 2, 2) derivatives there.
    """
    u, v, w = np.einsum("nij,nj->in", h, np.column_stack([xy, np.ones(len(xy))]))
    image = np.stack([u / w, v / w], axis=1)
    return image, (h[:, :2, :2] - image[:, :, None] * h[:, 2:, :2]) / w[:, None, None]


def align_matches(
    result: PairResult,
    gray0: np.ndarray,
    gray1: np.ndarray,
    scale0: tuple[float, float],
    scale1: tuple[float, float],
    *,
    octaves: int,
    max_error_px: float,
) -> AlignedMatches:
    """Move the second keypoints of a pair's matches to a fraction of a pixel.

    Args:
      gray0, gray1: float32 (h, w) intensities of the working images.
      scale0, scale1: original pixels per working pixel, (x, y).
      octaves: number of sizes to align at: working size, half of it, ...
      max_error_px: largest distance of an aligned keypoint from where its homography puts it,
        working pixels. This is the error that the matches were verified with.
    """
    pixels0, pixels1, s0, s1 = Pixels(scale0), Pixels(scale1), *map(np.asarray, (scale0, scale1))
    original0 = result.keypoints0.astype(np.float64)
    xy0 = pixels0.from_original(original0)
    xy1 = pixels1.from_original(result.keypoints1.astype(np.float64))
    on_plane, affine = local_map(result.homographies[result.plane], original0)
    on_plane, affine = pixels1.from_original(on_plane), affine * s0 / s1[:, None]
    patch, limits = square_patch(DEFAULTS.radius), AlignmentLimits.of(DEFAULTS)
    aligned = np.zeros(len(xy1), bool)
    if not len(xy1):
        return AlignedMatches(pixels1.to_original(xy1), aligned)
    for px in (2**octave for octave in reversed(range(octaves))):
        image0, image1 = (padded(block_means(image, px)) for image in (gray0, gray1))
        octave = Pixels.octave(px)
        at0, at1 = (octave.from_original(xy) for xy in (xy0, xy1))
        calls = []
        for piece, count in chunks(np.arange(len(xy1))):
            templates = make_templates(image0, at0[piece], patch)
            outcome = align_patches(
                image1, templates, at1[piece], affine[piece], patch, iterations=DEFAULTS.iterations
            )
            calls.append((count, outcome))
        found = to_host(calls)
        moved = octave.to_original(np.asarray(found.xy)).astype(np.float32)
        off_plane = np.linalg.norm(moved - on_plane, axis=1)
        good = limits.accept(found, at1) & (off_plane < max_error_px)
        xy1[good], aligned[good] = moved[good], True
    return AlignedMatches(pixels1.to_original(xy1), aligned)


def align(
    result: PairResult, image0: ImageFile, image1: ImageFile, *, config: Config
) -> AlignedMatches:
    """Align the matches of one pair to a fraction of a pixel, where the two images agree.

    In a reconstruction a keypoint is shared by all pairs of its image. So there
    `jaxsfm.sfm.refine.passes` aligns whole tracks instead.

    Args:
      result: the matches of the same images (`match`), with the same config.

    Raises:
      ImageError: an image cannot be decoded.
    """
    if not config.aligned_octaves or not result.num_inliers:
        still = np.zeros(result.num_inliers, bool)
        return AlignedMatches(result.keypoints1.astype(np.float64), still)
    first, second = (
        read_image(image, max_size=config.max_size, enlarge=config.enlarge)
        for image in (image0, image1)
    )
    return align_matches(
        result,
        intensities(first),
        intensities(second),
        first.scale,
        second.scale,
        octaves=config.aligned_octaves,
        max_error_px=config.threshold_px,
    )
