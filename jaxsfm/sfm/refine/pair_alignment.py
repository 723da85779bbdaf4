"""Sub-pixel matches: the second keypoint of every match moves to where the patch around the first,
warped by the match's homography, agrees with the second image.

From the coarsest size to the finest: relocalized keypoints are off by a few pixels, and a patch
finds its place from about four. Where nothing agrees (another season, specular light) a keypoint
stays where it was.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxsfm.config import Config, Refinement
from jaxsfm.core import align as align_core
from jaxsfm.io.images import ImageFile, read_image
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.photos import intensities
from jaxsfm.sfm.refine.padding import block_means, chunks, padded

RADIUS, ITERATIONS = Refinement.radius, Refinement.iterations
"""Of the patch, pixels of the octave, and Gauss-Newton steps; these and the limits are those of the
refinement."""
MIN_SCORE = Refinement.min_score
"""Least normalised cross-correlation. In unlike light and seasons 0.6 lets in patches that only
look alike (docs/design.md)."""
MAX_SIGMA_PX = Refinement.max_sigma_px
"""Largest standard deviation of a position along its worst direction, pixels of the octave: an
edge moves along itself."""
MAX_SHIFT_PX = Refinement.max_shift_px
"""Furthest of one octave, pixels of the octave."""


class AlignedMatches(NamedTuple):
    """Matches moved to sub-pixel accuracy."""

    keypoints1: np.ndarray
    """float64 (n, 2): original pixels of the second image."""
    aligned: np.ndarray
    """bool (n,): moved; the others stay where they were."""


def local_map(h: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where homographies (n, 3, 3) put points (n, 2), and their derivatives (n, 2, 2) there: what a
    small offset becomes.

    Source: Hartley and Zisserman, 2nd ed., section 2.2 (the affinity that agrees to first order).
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
    """Where the second keypoints of a pair's matches belong, to a fraction of a pixel.

    Args:
      gray0, gray1: float32 (h, w) intensities of the working images.
      scale0, scale1: original pixels per working pixel, (x, y).
      octaves: sizes to align at: working size, half of it, ...
      max_error_px: furthest a keypoint may end from where its homography puts it, working pixels:
        the error it was verified with.
    """
    s0, s1 = np.asarray(scale0, np.float64), np.asarray(scale1, np.float64)
    original0 = result.keypoints0.astype(np.float64)
    xy0 = (original0 + 0.5) / s0 - 0.5
    xy1 = (result.keypoints1.astype(np.float64) + 0.5) / s1 - 0.5
    on_plane, affine = local_map(result.homographies[result.plane], original0)
    on_plane, affine = (on_plane + 0.5) / s1 - 0.5, affine * s0 / s1[:, None]
    patch = align_core.square_patch(RADIUS)
    aligned = np.zeros(len(xy1), bool)
    for px in (2**octave for octave in reversed(range(octaves))):
        maps = [padded(block_means(image, px)) for image in (gray0, gray1)]
        for piece, count in chunks(np.arange(len(xy1))):
            at0, at1 = ((xy[piece] + 0.5) / px - 0.5 for xy in (xy0, xy1))
            found = _align(maps, at0, at1, affine[piece], patch)
            moved = (found.xy + 0.5) * px - 0.5
            good = (
                found.converged
                & (found.score > MIN_SCORE)
                & (found.sigma < MAX_SIGMA_PX)
                & (np.linalg.norm(found.xy - at1, axis=1) < MAX_SHIFT_PX)
                & (np.linalg.norm(moved - on_plane[piece], axis=1) < max_error_px)
            )[:count]
            rows = piece[:count][good]
            xy1[rows], aligned[rows] = moved[:count][good], True
    return AlignedMatches((xy1 + 0.5) * s1 - 0.5, aligned)


def _align(
    maps: list[tuple[np.ndarray, np.ndarray]],
    xy0: np.ndarray,
    xy1: np.ndarray,
    affine: np.ndarray,
    patch: align_core.Patch,
) -> align_core.Aligned:
    """On the host: one octave, one chunk."""
    (map0, size0), (map1, size1) = maps
    templates = align_core.make_templates(
        map0,  # pyright: ignore[reportArgumentType]
        size0,  # pyright: ignore[reportArgumentType]
        np.float32(xy0),  # pyright: ignore[reportArgumentType]
        patch,
    )
    return jax.device_get(
        align_core.align(
            map1,  # pyright: ignore[reportArgumentType]
            size1,  # pyright: ignore[reportArgumentType]
            templates,
            np.float32(xy1),  # pyright: ignore[reportArgumentType]
            np.float32(affine),  # pyright: ignore[reportArgumentType]
            patch,
            iterations=ITERATIONS,
        )
    )


def align(
    result: PairResult, image0: ImageFile, image1: ImageFile, *, config: Config
) -> AlignedMatches:
    """The matches with second keypoints to a fraction of a pixel, where the two images agree.

    For one pair: in a reconstruction a keypoint is shared by all pairs of its image, and
    `jaxsfm.sfm.refine.passes` aligns whole tracks.

    Args:
      result: of `jaxsfm.matching.pair_matching.match_features` with the same images and config.

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
        intensities(first.rgb),
        intensities(second.rgb),
        first.scale,
        second.scale,
        octaves=config.aligned_octaves,
        max_error_px=config.threshold_px,
    )
