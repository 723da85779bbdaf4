"""Multi-view refinement of keypoints, in passes after mapping.

In a pass, every observation of a track is moved onto one reference patch. Views into which the
point projects, and that agree with the patch, get new observations; observations that do not agree
are dropped. Bundle adjustment and filtering follow.

The reference keypoint stays where it is, because it defines the point. So the spread of relocalized
keypoints over the views (1-2 px) goes, and a track reaches every view that shows its surface. Views
that show too little to be aligned in this way are placed at the end, on the structure of the others
(`jaxsfm.sfm.refine.weak_views`).

A few hundred points for each view make the poses good, so all passes but the last one are done with
the points of the matches that the mapper was given. Then all others return.
"""

import contextlib
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

from jaxsfm.colmap.model import Model, Sizes
from jaxsfm.config import Refinement
from jaxsfm.io.images import ImageError
from jaxsfm.io.photos import Reader
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.evidence import NO_EVIDENCE, Evidence
from jaxsfm.sfm.refine.one_pass import MIN_POINTS, PassFigures, PassSettings, Refined, run_pass
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits
from jaxsfm.sfm.refine.weak_views import Placement, place_weak_views, remove_unconfirmed

if TYPE_CHECKING:
    import pycolmap


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefinementFigures:
    """The result of the refinement of a model."""

    passes: list[PassFigures]
    placed: list[Placement]
    """One for each view that was weak in any pass, and for each image that the mapper left out."""


def _as_arrays(reconstruction: "pycolmap.Reconstruction", sizes: Sizes) -> Refined:
    return Refined(reconstruction, Model.from_colmap(reconstruction, sizes))


def _sizes_of_passes(passes: int, described_px: int) -> list[int]:
    """The sizes of a pixel in all passes, working pixels."""
    larger = [2**k for k in reversed(range(described_px.bit_length() - 1))]
    return [described_px] * passes + larger


def _working_sizes(
    reconstruction: "pycolmap.Reconstruction", read: Reader, evidence: Evidence
) -> tuple[Sizes, Evidence]:
    """The sizes of all images, and the evidence without unmapped images that cannot be read."""

    def working_size(name: str) -> tuple[tuple[int, int], tuple[float, float]]:
        gray, scale = read(name)
        return (gray.shape[1], gray.shape[0]), scale

    sizes = {}
    for image_id in sorted(reconstruction.reg_image_ids()):
        name = reconstruction.image(image_id).name
        sizes[name] = working_size(name)
    readable = []
    for image in evidence.unmapped:
        with contextlib.suppress(ImageError):  # deleted since; it is not in the model anyway
            sizes[image.name] = working_size(image.name)
            readable.append(image)
    return sizes, evidence._replace(unmapped=readable)


def refine_model(
    reconstruction: "pycolmap.Reconstruction",
    read: Reader,
    *,
    refinement: Refinement,
    refine_intrinsics: bool,
    evidence: Evidence = NO_EVIDENCE,
    with_all_points: "Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction] | None" = None,
    described_px: int = 1,
    threads: int = -1,
    on_pass: Callable[[], None] = lambda: None,
) -> "tuple[pycolmap.Reconstruction, RefinementFigures]":
    """Refine a model.

    Thresholds are in pixels of the working images. An image where too little agrees keeps its old
    observations, with four times the error limit, until it is placed on the refined structure. One
    that cannot be placed and has hardly any observations is taken out. A pass that would lose most
    of the points is taken back.

    Args:
      reconstruction: from the mapper; not changed.
      read: intensities by image name; may be called several times per image.
      refine_intrinsics: whether bundle adjustment moves focal lengths and distortion.
      evidence: images that the mapper left out, and matches to place them and weak views by.
      with_all_points: gives a model the points of all matches, before the last of the `passes`.
        None: it has them already.
      described_px: the size of a pixel in which the keypoints were found, a power of two of working
        pixels. The `passes` are done with images of this size, and one more follows at each size
        above it, up to the working size: keypoints of a small image are too far off for a larger
        one.
      threads: of bundle adjustment. With one thread the model is repeatable to the last byte.

    Raises:
      ImageError: an image of the model cannot be read any more.
    """
    sizes, evidence = _working_sizes(reconstruction, read, evidence)
    images, settings = DeviceImages(read), PassSettings(refinement, refine_intrinsics, threads)
    now = _as_arrays(reconstruction, sizes)
    figures: list[PassFigures] = []
    limits = AlignmentLimits.of(refinement)
    for number, px in enumerate(_sizes_of_passes(refinement.passes, described_px)):
        if number > 0:
            limits = limits._replace(max_shift_px=refinement.max_shift_px / 2)
        if with_all_points is not None and number == refinement.passes - 1:
            now, with_all_points = _as_arrays(with_all_points(now.reconstruction), sizes), None
            limits = AlignmentLimits.of(refinement)  # the keypoints of new points are not aligned
        if len(now.model.tracks.points) < MIN_POINTS or len(now.model.views) < 2:
            break
        now, done = run_pass(now, images, px, limits, settings)
        figures.append(done)
        on_pass()
        if not done.accepted:
            break
    if with_all_points is not None:  # the passes ended early
        now = _as_arrays(with_all_points(now.reconstruction), sizes)
    reconstruction, model = now
    placed: list[Placement] = []
    # A view that was weak in any pass is placed: what little agreed in the first pass looks like
    # much in the next (58 of 153 observations after 22 of 393, and the camera 0.4 m off).
    weak_names = sorted({name for f in figures if f.accepted for name in f.weak_views})
    if any(f.accepted for f in figures) and (weak_names or evidence.unmapped):
        before = model
        model, placed = place_weak_views(
            model,
            weak_names,
            images,
            sizes,
            refinement=refinement,
            refine_intrinsics=refine_intrinsics,
            evidence=evidence,
        )
        if model is not before:
            reconstruction = model.to_colmap()
        if refinement.weak_octaves:  # otherwise nothing has tried to confirm their poses
            if model is not before:  # COLMAP left out points whose rays are too close
                model = Model.from_colmap(reconstruction, sizes)
            before = model
            model, placed = remove_unconfirmed(model, placed)
            if model is not before:
                reconstruction = model.to_colmap()
    return reconstruction, RefinementFigures(passes=figures, placed=placed)
