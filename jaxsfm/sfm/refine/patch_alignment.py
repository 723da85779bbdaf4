"""The alignment of patches (`jaxsfm.core.align`) in calls that the host does not wait for, and the
limits within which its outcome counts.

Images and templates stay on the device. The outcomes of several calls come to the host together.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from jaxsfm.config import Refinement
from jaxsfm.core import align as align_core
from jaxsfm.core.align import Aligned, Patch, Templates
from jaxsfm.io.traced_programs import Traced
from jaxsfm.sfm.refine.device_images import PaddedImage

_make_templates = Traced(align_core.make_templates, Patch, Templates)
_align = Traced(align_core.align, Patch, Templates, Aligned)


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


def make_templates(image: PaddedImage, xy: np.ndarray, patch: Patch) -> Templates:
    """Reference patches around keypoints (n, 2) of an image; on the device, without waiting."""
    return _make_templates(*image, jax.device_put(np.float32(xy)), patch)


def align_patches(
    image: PaddedImage,
    templates: Templates,
    start: np.ndarray,
    affine: np.ndarray,
    patch: Patch,
    *,
    iterations: int,
) -> Aligned:
    """Move reference patches over an image until they agree; on the device, without waiting.

    Args:
      start: (n, 2), where each patch starts, pixels of the image.
      affine: (n, 2, 2), from offsets in the reference image to offsets in this image.
      iterations: number of steps.
    """
    start, affine = jax.device_put((np.float32(start), np.float32(affine)))
    return _align(*image, templates, start, affine, patch, iterations=iterations)


def to_host(calls: Sequence[tuple[int, Aligned]]) -> Aligned:
    """Wait for the outcomes of calls, and join them as arrays of the host.

    Args:
      calls: for each call, how many of its rows count (`jaxsfm.sfm.refine.device_images.chunks`),
        and its outcome.
    """
    counts = [count for count, _ in calls]
    found = jax.device_get([outcome for _, outcome in calls])
    columns = zip(*found, strict=True)
    return Aligned(
        *(
            np.concatenate([each[:count] for count, each in zip(counts, column, strict=True)])
            for column in columns
        )  # pyright: ignore[reportArgumentType]
    )


Started = TypeVar("Started")


def overlapped(work: Iterable[Started]) -> Iterator[Started]:
    """Yield each piece of work when it is done, which is after the next one has been started.

    So the device has work while the host prepares more. When a piece is yielded, it and all before
    it are done, and only the next one may still run. What only the earlier ones used may be
    dropped.

    Args:
      work: starts a piece when it is asked for the next one, and gives its arrays, of which some
        are still being computed.
    """
    last: list[Started] = []
    for piece in work:
        if last:
            yield jax.block_until_ready(last.pop())
        last.append(piece)
    yield from jax.block_until_ready(last)
