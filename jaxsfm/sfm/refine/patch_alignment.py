"""The alignment of patches (`jaxsfm.core.align`), called with arrays of the host, and the limits
within which its outcome counts.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxsfm.config import Refinement
from jaxsfm.core import align as align_core
from jaxsfm.core.align import Aligned, Patch, Templates


class AlignmentLimits(NamedTuple):
    """Limits that an aligned keypoint must keep to count as an observation."""

    min_score: float
    """Least normalised cross-correlation with the reference patch."""
    max_sigma_px: float
    """Largest standard deviation of the position along its worst direction. On an edge a position
    is uncertain along the edge."""
    max_shift_px: float
    """Largest distance from where the alignment started."""

    @classmethod
    def of(cls, refinement: Refinement) -> "AlignmentLimits":
        """The limits of the first pass of a refinement."""
        return cls(refinement.min_score, refinement.max_sigma_px, refinement.max_shift_px)

    def accept(self, found: Aligned, start: np.ndarray) -> np.ndarray:
        """bool (n,): which keypoints count.

        Args:
          found: on the host.
          start: float (n, 2), where the alignment started, pixels.
        """
        return (
            np.asarray(found.converged)
            & (np.asarray(found.score) > self.min_score)
            & (np.asarray(found.sigma) < self.max_sigma_px)
            & (np.linalg.norm(found.xy - start, axis=1) < self.max_shift_px)
        )


class PaddedImage(NamedTuple):
    """An image in one of the few shapes that the alignment is compiled for."""

    map: np.ndarray
    """float32 (h, w, 1), zero beyond the image."""
    size: np.ndarray
    """int32 (2,): height and width of the image."""


def make_templates(image: PaddedImage, xy: np.ndarray, patch: Patch) -> Templates:
    """Reference patches around keypoints (n, 2) of an image, on the device."""
    return align_core.make_templates(
        image.map,  # pyright: ignore[reportArgumentType]
        image.size,  # pyright: ignore[reportArgumentType]
        np.float32(xy),  # pyright: ignore[reportArgumentType]
        patch,
    )


def align_patches(
    image: PaddedImage,
    templates: Templates,
    start: np.ndarray,
    affine: np.ndarray,
    patch: Patch,
    *,
    iterations: int,
) -> Aligned:
    """Move reference patches over an image until they agree with it; on the host.

    Args:
      start: (n, 2), where each patch starts, pixels of the image.
      affine: (n, 2, 2), from offsets in the reference image to offsets in this image.
      iterations: Gauss-Newton steps.
    """
    return jax.device_get(
        align_core.align(
            image.map,  # pyright: ignore[reportArgumentType]
            image.size,  # pyright: ignore[reportArgumentType]
            templates,
            np.float32(start),  # pyright: ignore[reportArgumentType]
            np.float32(affine),  # pyright: ignore[reportArgumentType]
            patch,
            iterations=iterations,
        )
    )
